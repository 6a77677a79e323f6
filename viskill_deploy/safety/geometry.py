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

    A PSM's shaft ends at the wrist's first axis, two joints before the tip. A straight instrument
    has no joint behind its shaft: for it the wrist is the shaft's own end, at the control point.

    Attributes:
        hand: those links that lie behind the shaft's end.
        arm: the others.
        below, above: which joints those are, from the last to the first.
        tip_axes: columns of the rotation from the last joint's frame to the tip.
        point, jaw_end: control point and end of the closed jaw in the last joint's frame, m.
        wrist, shaft_end: the wrist's first axis, and where the shaft's rounded end begins, in the
            frame of the last joint of `arm`, m.
        T_task_base: first three rows of the base's pose in the task frame.
    """

    hand: tuple[Link, ...]
    arm: tuple[Link, ...]
    below: slice
    above: slice
    tip_axes: tuple[Point, Point, Point]
    point: Point
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
        length, point = arm.jaw.finger_length_m, arm.tip_position
        along: Point = z
        if arm.has_remote_centre:
            pitch, behind = arm.joints[4], 2
            rise, tilt = pitch.d_m, pitch.alpha_rad
            wrist, along = (pitch.a_m, -sin(tilt) * rise, cos(tilt) * rise), (0.0, 0.0, 1.0)
        else:
            behind, wrist = 0, point
        last = len(links) - 1
        first, second, third, _ = [(*map(float, row),) for row in cell_arm.T_task_base.tolist()]
        return cls(
            hand=links[:behind],
            arm=links[behind:],
            below=slice(last, last - behind, -1),
            above=slice(last - behind, None, -1),
            tip_axes=(x, y, z),
            point=point,
            jaw_end=_mixed(1.0, point, length, z),
            wrist=wrist,
            shaft_end=_mixed(1.0, wrist, -arm.shape.shaft_radius_m, along),
            T_task_base=(first, second, third),  # type: ignore[arg-type]
        )

    def points(self, q: Joints) -> Points:
        """Control point (jaw pivot), end of the closed jaw, wrist and end of the shaft.

        Args:
            q: joint positions; what follows them is not read.
        """
        arm, above = self.arm, q[self.above]
        point, jaw_end = _carried(self.hand, q[self.below], self.point, self.jaw_end)
        point, jaw_end = _carried(arm, above, point, jaw_end)
        wrist, shaft_end = _carried(arm, above, self.wrist, self.shaft_end)
        in_task = self.in_task
        return in_task(point), in_task(jaw_end), in_task(wrist), in_task(shaft_end)

    def jacobian(self, q: Joints) -> list[list[float]]:
        """A column vx vy vz wx wy wz of the control point for each joint, base axes, rad and m.

        Craig, section 5.8: a joint's axis is the z axis of its own frame.

        Args:
            q: joint positions; what follows them is not read.
        """
        o, x, y, z = ORIGIN, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
        axes: list[tuple[bool, Point, Point]] = []
        for (slides, ca, sa, a, theta, d), position in zip(
            reversed(self.hand + self.arm), q, strict=False
        ):
            angle, rise = (theta, d + position) if slides else (theta + position, d)
            y, z = _mixed(ca, y, sa, z), _mixed(-sa, y, ca, z)
            o = _mixed(1.0, o, 1.0, _mixed(a, x, rise, z))
            axes.append((slides, z, o))
            c, s = cos(angle), sin(angle)
            x, y = _mixed(c, x, s, y), _mixed(-s, x, c, y)
        a, b, c = self.point
        o = _mixed(1.0, o, 1.0, _mixed(a, x, 1.0, _mixed(b, y, c, z)))
        return [
            [*z, 0.0, 0.0, 0.0] if slides else [*_cross(z, _mixed(1.0, o, -1.0, at)), *z]
            for slides, z, at in axes
        ]

    def tip_pose(self, q: Joints) -> tuple[Row, Row, Row]:
        """First three rows of T_base_tip, for the tests that hold it against other models."""
        x_axis, y_axis, z_axis = self.tip_axes
        links = self.hand + self.arm
        back = q[len(links) - 1 :: -1]
        origin, x = _carried(links, back, ORIGIN, x_axis)
        y, z = _carried(links, back, y_axis, z_axis)
        point, _ = _carried(links, back, self.point, ORIGIN)
        rows = [(x[i] - p, y[i] - p, z[i] - p, point[i]) for i, p in enumerate(origin)]
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
