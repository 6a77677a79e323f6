"""From joints to the actuators that drive them, and on to a drive's counts, and back.

Axes 0 to 2 drive yaw, pitch and insertion directly. Axes 3 to 6 drive roll, wrist pitch, wrist yaw
and jaw together: joints = A x actuators, with the matrix A of the instrument's file.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from viskill_deploy.core.description import ArmDescription
from viskill_deploy.core.types import FloatArray

if TYPE_CHECKING:
    from viskill_deploy.drivers.can.config import Bus

WIDER = 0.05
"""Part of an actuator's range by which its limits may be wider than the instrument needs."""


def full_matrix(arm: ArmDescription) -> FloatArray:
    """Joints (7,), jaw last, per actuator (7,)."""
    A = np.eye(7)
    A[3:, 3:] = arm.actuator_to_joint
    return A


def actuator_ranges(arm: ArmDescription) -> list[tuple[float, float]]:
    """What each actuator needs for the joints to reach all of their limits, rad or m."""
    lower = np.array([*arm.limit(0), arm.jaw.lower_rad])
    upper = np.array([*arm.limit(1), arm.jaw.upper_rad])
    inverse = np.linalg.inv(full_matrix(arm))
    middle, half = inverse @ (upper + lower) / 2, np.abs(inverse) @ (upper - lower) / 2
    return list(zip((middle - half).tolist(), (middle + half).tolist(), strict=True))


class Gearing:
    """Between one arm's joints and the counts of its drives.

    Plain floats: it runs in every control period.

    Args:
        arm: the arm with its instrument.
        bus: its drives; their scale, sign and offset.
    """

    def __init__(self, arm: ArmDescription, bus: Bus) -> None:
        A = np.array(arm.actuator_to_joint)
        self._to_joint: list[list[float]] = A.tolist()
        self._to_actuator: list[list[float]] = np.linalg.inv(A).tolist()
        self._scales = [axis.sign * axis.scale for axis in bus.axis]
        self._offsets = [axis.offset for axis in bus.axis]

    def actuators(self, joints: Sequence[float]) -> list[float]:
        """Actuators (7,) for joints (7,), jaw last."""
        return [*joints[:3], *_product(self._to_actuator, joints[3:])]

    def joints(self, actuators: Sequence[float]) -> list[float]:
        """Joints (7,), jaw last, for actuators (7,)."""
        return [*actuators[:3], *_product(self._to_joint, actuators[3:])]

    def counts(self, joints: Sequence[float]) -> list[int]:
        """What each drive is told, for joints (7,), jaw last."""
        turned = self.actuators(joints)
        return [
            round((x - offset) * scale)
            for x, offset, scale in zip(turned, self._offsets, self._scales, strict=True)
        ]

    def joints_of_counts(self, counts: Sequence[float]) -> list[float]:
        """Joints (7,), jaw last, where the drives are at `counts`."""
        return self.joints(
            [
                offset + n / scale
                for n, offset, scale in zip(counts, self._offsets, self._scales, strict=True)
            ]
        )


def _product(matrix: list[list[float]], vector: Sequence[float]) -> list[float]:
    a, b, c, d = vector
    return [row[0] * a + row[1] * b + row[2] * c + row[3] * d for row in matrix]
