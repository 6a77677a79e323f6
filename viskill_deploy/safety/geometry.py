"""The gate's own forward kinematics: a second implementation, in plain floats, on purpose.

One wrong model cannot fool both the IK and the gate: tests hold this one equal to Pinocchio within
1e-9. It never multiplies matrices. It carries points from the last joint's frame down the chain to
the base, link by link, which needs two plane rotations a link (Craig, Introduction to Robotics,
3rd ed., eq. 3.6: Rx(alpha) Tx(a) Rz(theta) Tz(d)).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin

from viskill_deploy.core.description import CellArm
from viskill_deploy.core.types import Joints

Point = tuple[float, float, float]
Points = tuple[Point, Point, Point, Point]
"""Control point, jaw end, wrist, end of the shaft: task frame, m."""
ORIGIN: Point = (0.0, 0.0, 0.0)
Row = tuple[float, float, float, float]


Link = tuple[bool, float, float, float, float, float]
"""Whether the joint slides, cos and sin of alpha, a, theta and d at zero joint position."""


@dataclass(frozen=True, slots=True)
class Chain:
    """An arm's links from the last to the first, and where its base stands.

    Attributes:
        tip_axes: columns of the rotation from the last joint's frame to the tip.
        jaw_end: end of the closed jaw in the last joint's frame, m.
        wrist, shaft_end: the wrist's first axis, and where the shaft's rounded end begins, in the
            frame of the roll, m; the shaft's axis is z there.
        T_task_base: first three rows of the base's pose in the task frame.
    """

    links: tuple[Link, ...]
    tip_axes: tuple[Point, Point, Point]
    jaw_end: Point
    wrist: Point
    shaft_end: Point
    T_task_base: tuple[Row, Row, Row]

    @classmethod
    def of(cls, cell_arm: CellArm) -> Chain:
        """The chain of one arm of a cell."""
        arm = cell_arm.arm
        links = tuple(
            (
                joint.type == "prismatic",
                cos(joint.alpha_rad),
                sin(joint.alpha_rad),
                joint.a_m,
                joint.theta_rad + (joint.offset if joint.type == "revolute" else 0.0),
                joint.d_m + (joint.offset if joint.type == "prismatic" else 0.0),
            )
            for joint in reversed(arm.joints)
        )
        x, y, z = (_point(column) for column in arm.tip_rotation.T.tolist())
        length = arm.jaw.finger_length_m
        pitch = arm.joints[4]
        rise, tilt = pitch.d_m, pitch.alpha_rad
        wrist = (pitch.a_m, -sin(tilt) * rise, cos(tilt) * rise)
        rows = [(*map(float, row),) for row in cell_arm.T_task_base.tolist()[:3]]
        return cls(
            links=links,
            tip_axes=(x, y, z),
            jaw_end=(length * z[0], length * z[1], length * z[2]),
            wrist=wrist,
            shaft_end=(wrist[0], wrist[1], wrist[2] - arm.shape.shaft_radius_m),
            T_task_base=((*rows[0],), (*rows[1],), (*rows[2],)),  # type: ignore[arg-type]
        )

    def points(self, q: Joints) -> Points:
        """Control point (jaw pivot), end of the closed jaw, wrist and end of the shaft.

        Args:
            q: joint positions, the first six entries are read.
        """
        hand, below, arm, above = self.links[:2], q[5:3:-1], self.links[2:], q[3::-1]
        point, jaw_end = _carried(hand, below, ORIGIN, self.jaw_end)
        point, jaw_end = _carried(arm, above, point, jaw_end)
        wrist, shaft_end = _carried(arm, above, self.wrist, self.shaft_end)
        in_task = self.in_task
        return in_task(point), in_task(jaw_end), in_task(wrist), in_task(shaft_end)

    def jacobian(self, q: Joints) -> list[list[float]]:
        """Six columns vx vy vz wx wy wz of the control point, base axes, rad and m.

        Craig, section 5.8: a joint's axis is the z axis of its own frame.

        Args:
            q: joint positions, the first six entries are read.
        """
        o, x, y, z = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
        axes: list[tuple[bool, Point, Point]] = []
        for (slides, ca, sa, a, theta, d), position in zip(reversed(self.links), q, strict=False):
            angle, rise = (theta, d + position) if slides else (theta + position, d)
            y, z = _mixed(ca, y, sa, z), _mixed(-sa, y, ca, z)
            o = _mixed(1.0, o, 1.0, _mixed(a, x, rise, z))
            axes.append((slides, z, o))
            c, s = cos(angle), sin(angle)
            x, y = _mixed(c, x, s, y), _mixed(-s, x, c, y)
        return [
            [*z, 0.0, 0.0, 0.0] if slides else [*_cross(z, _mixed(1.0, o, -1.0, at)), *z]
            for slides, z, at in axes
        ]

    def tip_pose(self, q: Joints) -> tuple[Row, Row, Row]:
        """First three rows of T_base_tip, for the tests that hold it against other models."""
        x_axis, y_axis, z_axis = self.tip_axes
        origin, x = _carried(self.links, q[5::-1], ORIGIN, x_axis)
        y, z = _carried(self.links, q[5::-1], y_axis, z_axis)
        rows = [(x[i] - p, y[i] - p, z[i] - p, p) for i, p in enumerate(origin)]
        return rows[0], rows[1], rows[2]

    def in_task(self, point: Point) -> Point:
        """A point of the base's frame, seen from the task's."""
        x, y, z = point
        (a, b, c, d), (e, f, g, h), (i, j, k, m) = self.T_task_base
        return (
            a * x + b * y + c * z + d,
            e * x + f * y + g * z + h,
            i * x + j * y + k * z + m,
        )


def _carried(
    links: tuple[Link, ...], q: Joints, first: Point, second: Point
) -> tuple[Point, Point]:
    """Two points of the first link's frame, seen from before the last link."""
    x, y, z = first
    u, v, w = second
    for (slides, ca, sa, a, theta, d), position in zip(links, q, strict=True):
        angle, rise = (theta, d + position) if slides else (theta + position, d)
        c, s = cos(angle), sin(angle)
        z += rise
        w += rise
        x, y = c * x - s * y + a, s * x + c * y
        u, v = c * u - s * v + a, s * u + c * v
        y, z = ca * y - sa * z, sa * y + ca * z
        v, w = ca * v - sa * w, sa * v + ca * w
    return (x, y, z), (u, v, w)


def _mixed(a: float, first: Point, b: float, second: Point) -> Point:
    x, y, z = first
    u, v, w = second
    return a * x + b * u, a * y + b * v, a * z + b * w


def _cross(first: Point, second: Point) -> Point:
    x, y, z = first
    u, v, w = second
    return y * w - z * v, z * u - x * w, x * v - y * u


def _point(values: list[float]) -> Point:
    x, y, z = values
    return x, y, z
