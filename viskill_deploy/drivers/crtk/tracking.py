"""When a simulated arm is too far from its setpoint for dVRK's controller to go on."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from viskill_deploy.core.description import ArmDescription
from viskill_deploy.drivers.crtk.topics import Version

TOLERANCES: dict[Version, tuple[float, ...]] = {
    "2.4": (0.5, 0.5, 0.05, 0.6, 0.6, 0.6, 0.6),
    "2.3": (
        math.radians(20),
        math.radians(20),
        0.02,
        math.radians(35),
        math.radians(35),
        math.radians(35),
        math.radians(90),
    ),
}
"""Largest difference between setpoint and measurement of each actuator, rad or m."""


class TrackingCheck:
    """Compares actuators, as dVRK does: the last four of them drive roll, wrist and jaw together.

    Args:
        arm: the arm with its instrument.
        version: whose tolerances hold.
    """

    def __init__(self, arm: ArmDescription, version: Version) -> None:
        self._tolerances = TOLERANCES[version]
        self._to_actuator: list[list[float]] = np.linalg.inv(arm.actuator_to_joint).tolist()

    def too_far(self, setpoint: Sequence[float], measured: Sequence[float]) -> tuple[bool, ...]:
        """Which actuators are too far off, for joints (7,), jaw last; () when none is."""
        off = [a - b for a, b in zip(setpoint, measured, strict=True)]
        pairs = zip(self.actuators(off), self._tolerances, strict=True)
        mask = tuple(not abs(x) <= tolerance for x, tolerance in pairs)
        return mask if any(mask) else ()

    def actuators(self, joints: Sequence[float]) -> tuple[float, ...]:
        """Actuators (7,) for joints (7,), jaw last."""
        a, b, c, d = joints[3:]
        wrist = [row[0] * a + row[1] * b + row[2] * c + row[3] * d for row in self._to_actuator]
        return (*joints[:3], *wrist)
