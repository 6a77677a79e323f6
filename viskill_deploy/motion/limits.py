"""What plans may ask of an arm: 90 % of what the gate allows, inside its position margins."""

from __future__ import annotations

from dataclasses import dataclass

from viskill_deploy.core.description import PLAN_FRACTION, ArmDescription

POSITION_MARGINS = 2.0
"""Plans stay this many of the gate's position margins away from a joint limit."""


@dataclass(frozen=True, slots=True)
class PlanLimits:
    """Limits of the seven axes of an arm (six joints, then the jaw), rad or m, s."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]
    velocity: tuple[float, ...]
    acceleration: tuple[float, ...]
    jerk: tuple[float, ...]

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
        lower[2] = max(lower[2], arm.insertion_min_m + margins[2])
        return cls(
            lower=(*lower, jaw.lower_rad),
            upper=(*(x - m for x, m in zip(arm.limit(1), margins, strict=True)), jaw.upper_rad),
            velocity=velocity,
            acceleration=acceleration,
            jerk=jerk,
        )

    def faster(self, k: float) -> PlanLimits:
        """The same limits for a clock that runs `k` times slower: v k, a k², j k³."""
        return PlanLimits(
            self.lower,
            self.upper,
            tuple(x * k for x in self.velocity),
            tuple(x * k**2 for x in self.acceleration),
            tuple(x * k**3 for x in self.jerk),
        )
