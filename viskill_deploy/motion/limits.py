"""What plans may ask of an arm: 90 % of what the gate allows, inside its position margins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from viskill_deploy.core.description import PLAN_FRACTION, ArmDescription
from viskill_deploy.core.types import FloatArray

SHAPE_VELOCITY = (1.4, 1.4, 0.18, 17.0, 17.0, 17.0, 5.4)
SHAPE_ACCELERATION = (7.0, 7.0, 0.9, 57.0, 57.0, 57.0, 57.0)
SHAPE_JERK = (140.0, 140.0, 18.0, 1130.0, 1130.0, 1130.0, 1130.0)
"""Rates at which a plan's path is drawn, axis by axis, rad or m, s: about a Classic PSM's own.

They are part of what a plan means and no arm's limits: the path depends on its waypoints and on
these numbers alone, so an arm with lower limits runs the same path under a slower clock.
"""

Rates = tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]
"""Velocity, acceleration and jerk of each axis."""

POSITION_MARGINS = 2.0
"""Plans stay this many of the gate's position margins away from a joint limit."""


@dataclass(frozen=True, slots=True)
class PlanLimits:
    """Limits of the axes of an arm (its joints, then the jaw), rad or m, s.

    `shape_rates` are velocity, acceleration and jerk at which its paths are drawn.
    """

    lower: tuple[float, ...]
    upper: tuple[float, ...]
    velocity: tuple[float, ...]
    acceleration: tuple[float, ...]
    jerk: tuple[float, ...]
    shape_rates: Rates = (SHAPE_VELOCITY, SHAPE_ACCELERATION, SHAPE_JERK)

    @classmethod
    def of(cls, arm: ArmDescription, fraction: float = PLAN_FRACTION) -> PlanLimits:
        """Limits for plans of `arm`.

        Args:
            arm: the arm with its instrument.
            fraction: part of the gate's velocity, acceleration and jerk that plans may use.
        """
        gate, jaw = arm.gate, arm.jaw
        margins = [
            POSITION_MARGINS
            * (gate.position_margin_m if j.type == "prismatic" else gate.position_margin_rad)
            for j in arm.joints
        ]
        jaw_rates = (jaw.max_velocity_rad_s, jaw.max_acceleration_rad_s2, jaw.max_jerk_rad_s3)
        velocity, acceleration, jerk = (
            tuple(fraction * x for x in (*arm.limit(2 + i), jaw_rates[i])) for i in range(3)
        )
        lower = [x + m for x, m in zip(arm.limit(0), margins, strict=True)]
        if arm.has_remote_centre:
            lower[2] = max(lower[2], arm.insertion_min_m + margins[2])
        return cls(
            lower=(*lower, jaw.lower_rad),
            upper=(*(x - m for x, m in zip(arm.limit(1), margins, strict=True)), jaw.upper_rad),
            velocity=velocity,
            acceleration=acceleration,
            jerk=jerk,
            shape_rates=_shape_rates(arm),
        )

    def shape(self) -> PlanLimits:
        """These position limits with the rates at which paths are drawn."""
        return PlanLimits(self.lower, self.upper, *self.shape_rates, self.shape_rates)

    def clock(self, velocity: FloatArray, acceleration: FloatArray, jerk: FloatArray) -> float:
        """How much slower time has to pass for a motion with these peaks (axes,) to be inside."""
        return float(
            max(
                (velocity / self.velocity).max(),
                np.sqrt((acceleration / self.acceleration).max()),
                np.cbrt((jerk / self.jerk).max()),
            )
        )

    def faster(self, k: float) -> PlanLimits:
        """The same limits for a clock that runs `k` times slower: v k, a k², j k³."""
        return PlanLimits(
            self.lower,
            self.upper,
            tuple(x * k for x in self.velocity),
            tuple(x * k**2 for x in self.acceleration),
            tuple(x * k**3 for x in self.jerk),
            self.shape_rates,
        )


def _shape_rates(arm: ArmDescription) -> Rates:
    """A PSM's own; another arm's joints are drawn like a PSM's first ones, and its jaw like its."""
    own = (SHAPE_VELOCITY, SHAPE_ACCELERATION, SHAPE_JERK)
    if arm.has_remote_centre:
        return own
    slides = [joint.type == "prismatic" for joint in arm.joints]
    velocity, acceleration, jerk = (
        (*(rate[2] if slide else rate[0] for slide in slides), rate[-1]) for rate in own
    )
    return velocity, acceleration, jerk
