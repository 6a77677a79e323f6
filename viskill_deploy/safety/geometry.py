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
Row = tuple[float, float, float, float]


Link = tuple[bool, float, float, float, float, float]
"""Whether the joint slides, cos and sin of alpha, a, theta and d at zero joint position."""


@dataclass(frozen=True, slots=True)
class Chain:
    """An arm's links from the last to the first, and where its base stands.

    Attributes:
        tip_axes: columns of the rotation from the last joint's frame to the tip.
        jaw_end: end of the closed jaw in the last joint's frame, m.
        T_task_base: first three rows of the base's pose in the task frame.
    """

    links: tuple[Link, ...]
    tip_axes: tuple[Point, Point, Point]
    jaw_end: Point
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
        rows = [(*map(float, row),) for row in cell_arm.T_task_base.tolist()[:3]]
        return cls(
            links=links,
            tip_axes=(x, y, z),
            jaw_end=(length * z[0], length * z[1], length * z[2]),
            T_task_base=((*rows[0],), (*rows[1],), (*rows[2],)),  # type: ignore[arg-type]
        )

    def points(self, q: Joints) -> tuple[Point, Point]:
        """Control point (jaw pivot) and end of the closed jaw in the task frame, m.

        Args:
            q: joint positions, the first six entries are read.
        """
        first, second = self._in_base(q, (0.0, 0.0, 0.0), self.jaw_end)
        return self._in_task(first), self._in_task(second)

    def tip_pose(self, q: Joints) -> tuple[Row, Row, Row]:
        """First three rows of T_base_tip, for the tests that hold it against other models."""
        x_axis, y_axis, z_axis = self.tip_axes
        origin, x = self._in_base(q, (0.0, 0.0, 0.0), x_axis)
        y, z = self._in_base(q, y_axis, z_axis)
        rows = [(x[i] - p, y[i] - p, z[i] - p, p) for i, p in enumerate(origin)]
        return rows[0], rows[1], rows[2]

    def _in_base(self, q: Joints, first: Point, second: Point) -> tuple[Point, Point]:
        """Two points of the last joint's frame, seen from the base."""
        x, y, z = first
        u, v, w = second
        for (slides, ca, sa, a, theta, d), position in zip(self.links, q[5::-1], strict=True):
            angle, rise = (theta, d + position) if slides else (theta + position, d)
            c, s = cos(angle), sin(angle)
            z += rise
            w += rise
            x, y = c * x - s * y + a, s * x + c * y
            u, v = c * u - s * v + a, s * u + c * v
            y, z = ca * y - sa * z, sa * y + ca * z
            v, w = ca * v - sa * w, sa * v + ca * w
        return (x, y, z), (u, v, w)

    def _in_task(self, point: Point) -> Point:
        x, y, z = point
        (a, b, c, d), (e, f, g, h), (i, j, k, m) = self.T_task_base
        return (
            a * x + b * y + c * z + d,
            e * x + f * y + g * z + h,
            i * x + j * y + k * z + m,
        )


def _point(values: list[float]) -> Point:
    x, y, z = values
    return x, y, z
