"""A second opinion on what a gate has let out: limits from the files, kinematics from Pinocchio.

It shares no code with the gate. A setpoint that was passed has to be inside every limit (a fifth
over a speed or an acceleration is what SCALE allows); one of the gate's own stop has to be inside
the joints' limits, and no faster, sharper or jerkier than the motion that it ends.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import JointSetpoint
from viskill_deploy.kinematics.arm import Arm

SCALED = 1.2
"""What a value may be of its limit while the time base is asked to slow down."""

TINY = 1e-6
"""Relative, and in rad or m: rounding of differences."""

OVERSHOOT_M = 0.0129
"""How far a stop may carry the control point beyond a wall. The longest that there is begins where
insertion has 1.2 times the tip's speed and of its own acceleration, just before a HOLD: 60 mm/s and
1.2 m/s^2 come to rest within w (a / J + w / 2A + A / 2J) = 12.8 mm, w = v + a^2 / 2J = 96 mm/s."""


@dataclass
class Trail:
    """What one arm was sent, cycle by cycle, without a gap."""

    rows: list[tuple[float, ...]] = field(default_factory=list)
    passed: list[bool] = field(default_factory=list)

    def add(self, setpoint: JointSetpoint, passed: bool) -> None:
        """The next cycle."""
        self.rows.append((*setpoint.jp, setpoint.jaw))
        self.passed.append(passed)


class Oracle:
    """Judges trails of the arms of one cell.

    Attributes:
        worst: by quantity, the largest part of its limit that was seen; 1.0 is the limit.
    """

    def __init__(self, cell: CellDescription, period_s: float) -> None:
        self.cell, self.period = cell, period_s
        self._arms = [Arm(entry.arm) for entry in cell.arms]
        self.worst: dict[str, float] = {}

    def escapes(self, arm: int, trail: Trail) -> list[str]:
        """What got out of the limits; empty when nothing did."""
        q, passed = np.array(trail.rows), np.array(trail.passed)
        description, jaw = self.cell.arms[arm].arm, self.cell.arms[arm].arm.jaw
        limits = [
            np.array([*description.limit(index), value])
            for index, value in enumerate(
                (
                    jaw.lower_rad,
                    jaw.upper_rad,
                    jaw.max_velocity_rad_s,
                    jaw.max_acceleration_rad_s2,
                    jaw.max_jerk_rad_s3,
                )
            )
        ]
        lower, upper, speed, acceleration, jerk = limits
        found = []
        middle, half = 0.5 * (lower + upper), 0.5 * (upper - lower)
        parts = abs(q - middle) / half
        found += self._over("joint position", parts[:, :6].max(axis=1), 1.0)
        # A stop may carry a jaw out of its range; what is passed then has to lead back in.
        opening = np.diff(parts[:, 6], prepend=parts[:1, 6]) > 0.0
        found += self._over("jaw position, passed outwards", parts[passed & opening, 6], 1.0)
        # Until acceleration is back at zero a stop may still gain speed: a^2 / 2J, and a sample.
        rise = SCALED * acceleration * (0.5 * SCALED * acceleration / jerk + self.period)
        for name, n, limit, more in (
            ("joint speed", 1, speed, rise / speed),
            ("joint acceleration", 2, acceleration, 0.0),
            ("joint jerk", 3, jerk, 0.0),
        ):
            if len(q) > n:
                rates = abs(np.diff(q, n=n, axis=0)) / self.period**n / limit
                asked = passed[n:]
                found += self._over(f"{name}, passed", rates[asked].max(axis=1, initial=0), SCALED)
                stops = (rates - more)[~asked].max(axis=1, initial=0.0)
                found += self._over(f"{name}, stop", stops, 1.0 if n == 3 else SCALED)
        return found + self._tip(arm, q, passed)

    def _tip(
        self, arm: int, q: npt.NDArray[np.float64], passed: npt.NDArray[np.bool_]
    ) -> list[str]:
        entry = self.cell.arms[arm]
        points = self._arms[arm].forward_batch(q[:, :6])[:, :3, 3]
        T = entry.T_task_base
        points = points @ T[:3, :3].T + T[:3, 3]
        found = []
        if len(q) > 1:
            speeds = np.linalg.norm(np.diff(points, axis=0), axis=1) / self.period
            limit = self.cell.file.motion.tip_speed_m_s
            found += self._over("tip speed, passed", speeds[passed[1:]] / limit, SCALED)
        lower = np.array(entry.entry.workspace_lower_m)
        upper = np.array(entry.entry.workspace_upper_m)
        outside = np.maximum(lower - points, points - upper).max(axis=1)
        found += self._over("way out of the workspace", outside / OVERSHOOT_M, 1.0)
        out = (outside > TINY) & passed
        out[1:] &= outside[1:] > outside[:-1] + 1e-9
        out[0] = False
        if out.any():
            found.append(f"passed on the way out of the workspace: {outside[out].max():.6f} m")
        return found

    def _over(self, name: str, parts: npt.NDArray[np.float64], allowed: float) -> list[str]:
        """Notes the largest part, and complains if it is above what is allowed."""
        largest = float(parts.max(initial=0.0))
        self.worst[name] = max(self.worst.get(name, 0.0), largest / allowed)
        bad = not largest <= allowed * (1.0 + TINY)
        return [f"{name}: {largest:.6f} of the limit"] if bad else []
