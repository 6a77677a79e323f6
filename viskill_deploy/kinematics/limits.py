"""Joint limits, and the box of velocities that keeps them over the next step."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

from viskill_deploy.core.description import PLAN_FRACTION, ArmDescription
from viskill_deploy.core.errors import IkError
from viskill_deploy.core.types import Joints

ROOM_SLACK = 1e-9
"""A position limit may be left by this much, rad or m: rounding."""

SPEED_SLACK = 1e-9
"""A previous velocity may exceed its limit by this much: rounding of whoever made it."""


@dataclass(frozen=True, slots=True)
class JointLimits:
    """Limits of n joints, rad and m, s.

    Attributes:
        lower: smallest positions, -inf allowed.
        upper: largest positions, inf allowed.
        velocity: largest speeds, positive.
        acceleration: largest accelerations, positive.

    Raises:
        IkError: "not-finite" for NaN, "bad-bounds" for lower > upper, different lengths or speeds
            and accelerations that are not positive.
    """

    lower: Joints
    upper: Joints
    velocity: Joints
    acceleration: Joints

    def __post_init__(self) -> None:
        columns = [
            tuple(map(float, column))
            for column in (self.lower, self.upper, self.velocity, self.acceleration)
        ]
        for name, column in zip(
            ("lower", "upper", "velocity", "acceleration"), columns, strict=True
        ):
            object.__setattr__(self, name, column)
            if any(map(math.isnan, column)):
                raise IkError("not-finite", f"{name} limits {column} hold NaN; give numbers")
        if len({len(column) for column in columns}) != 1:
            raise IkError("bad-bounds", "limits differ in length; give one of each per joint")
        for i, (low, high, speed, acceleration) in enumerate(zip(*columns, strict=True)):
            if low > high:
                raise IkError(
                    "bad-bounds", f"joint {i}: lower {low} above upper {high}; correct the limits"
                )
            if not (0.0 < speed < math.inf and 0.0 < acceleration < math.inf):
                raise IkError(
                    "bad-bounds",
                    f"joint {i}: velocity {speed} and acceleration {acceleration} must be positive "
                    "and finite; correct the limits",
                )

    @classmethod
    def planning(cls, arm: ArmDescription, fraction: float = PLAN_FRACTION) -> JointLimits:
        """What the line may use of an arm, so that the gate does not fire on a nominal run.

        The gate's position margins are taken off, the insertion starts where the wrist is outside
        the cannula, and speed and acceleration are multiplied by `fraction`.
        """
        margins = [
            arm.gate.position_margin_m
            if joint.type == "prismatic"
            else arm.gate.position_margin_rad
            for joint in arm.joints
        ]
        lower = [low + margin for low, margin in zip(arm.limit(0), margins, strict=True)]
        if arm.has_remote_centre:
            lower[2] = max(lower[2], arm.insertion_min_m + arm.gate.position_margin_m)
        return cls(
            lower=tuple(lower),
            upper=tuple(high - m for high, m in zip(arm.limit(1), margins, strict=True)),
            velocity=tuple(fraction * v for v in arm.limit(2)),
            acceleration=tuple(fraction * a for a in arm.limit(3)),
        )

    def velocity_box(
        self, q: Sequence[float], v_prev: Sequence[float], dt: float
    ) -> tuple[list[float], list[float]]:
        """Bounds on the velocity over the next `dt`, lower never above upper.

        Acceleration and speed bound it first; the position limit then bounds it by the speed from
        which the joint can still stop: v dt + v^2 / 2a <= room, which, once kept, can be kept for
        ever. Where the joint is too fast for its room, full braking is all that is left. A joint
        that starts outside its limits is sent back as fast as it may move.

        Args:
            q: positions, (n,).
            v_prev: velocities of the step before, (n,), inside the speed limits.
            dt: length of the step, s.

        Raises:
            IkError: "infeasible" when a previous velocity is beyond its limit, or too fast for the
                joint to stop before its position limit.
        """
        lower: list[float] = []
        upper: list[float] = []
        rows = zip(q, v_prev, self.lower, self.upper, self.velocity, self.acceleration, strict=True)
        for p, v, low, high, speed, acceleration in rows:
            change = acceleration * dt
            most, least = v + change, v - change
            if most > speed or least < -speed:
                if not -speed - SPEED_SLACK <= v <= speed + SPEED_SLACK:
                    raise _too_fast(len(lower), v, speed)
                most, least = min(most, speed), max(least, -speed)
            # Far from both limits, stopping needs less room than there is: no root to take.
            fastest = most if most > -least else -least
            needed = fastest * (dt + fastest / (2.0 * acceleration))
            up, down = high - p, p - low
            if up < needed:
                stop = stopping_speed(up, change, acceleration, dt)
                if stop < most:
                    most = stop if stop > least else _braking(len(lower), least, dt, up)
            if down < needed:
                stop = stopping_speed(down, change, acceleration, dt)
                if -stop > least:
                    least = -stop if -stop < most else -_braking(len(lower), -most, dt, down)
            upper.append(most)
            lower.append(least)
        return lower, upper


def stopping_speed(room: float, change: float, acceleration: float, dt: float) -> float:
    """The largest v with v dt + v^2 / 2a <= room: from it the joint can stop in its room.

    Outside the limits it is negative: back in one step.

    Args:
        room: distance to the limit, rad or m.
        change: of the speed in one step, acceleration times dt.
        acceleration: that the joint has.
        dt: length of a step, s.
    """
    if room <= 0.0:
        return room / dt
    return sqrt(change * change + 2.0 * acceleration * room) - change


def _braking(joint: int, speed: float, dt: float, room: float) -> float:
    """`speed`, the least that full braking leaves towards a limit, if there is room for it.

    A joint that is outside already and moves back, however slowly, has it.

    Raises:
        IkError: "infeasible": acceleration and position limits exclude each other.
    """
    over = speed * dt - max(room, 0.0)
    if over > ROOM_SLACK:
        raise IkError(
            "infeasible",
            f"joint {joint} at {speed:.6g} per s cannot stop before its limit: {over:.3g} over "
            "even at full braking; hold, then start from rest",
        )
    return speed


def _too_fast(joint: int, v: float, speed: float) -> IkError:
    """The refusal of a previous velocity beyond its limit."""
    return IkError(
        "infeasible", f"joint {joint} moves at {v:.6g}, over its limit {speed:.6g}; hold first"
    )
