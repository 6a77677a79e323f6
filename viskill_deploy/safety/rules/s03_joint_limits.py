"""S03: setpoints stay inside the joint limits less a margin, and so does the stop from each."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.stopping import JointStop
from viskill_deploy.safety.track import ArmTrack


class _Limits:
    """One joint: limits less margin, hard limits, and what bounds its way to rest."""

    __slots__ = ("acceleration", "hard", "inner", "jerk", "quadratic", "steady", "unjerk")

    def __init__(
        self, lower: float, upper: float, margin: float, acceleration: float, jerk: float
    ) -> None:
        self.inner = (lower + margin, upper - margin)
        self.hard = (lower, upper)
        self.acceleration, self.jerk = acceleration, jerk
        self.unjerk = 1.0 / jerk
        self.quadratic = 0.5 / acceleration
        self.steady = 0.5 * acceleration / jerk


class Rule:
    """HOLD on the way out; coming back in, or staying, passes.

    A setpoint passes only if the gate could still stop before the hard limit: a margin of 1 mm
    would be crossed in one 5 ms at full insertion speed. A plan that itself comes to rest inside
    the limits with less acceleration and jerk than the gate's stop never meets this.
    """

    id: ClassVar[str] = "S03"
    needs: ClassVar[Needs] = Needs.REQUEST

    def __init__(self, cell: CellEnvelope) -> None:
        self._half_period = 0.5 * cell.period
        self._arms = tuple(
            tuple(
                map(
                    _Limits,
                    arm.lower[:6],
                    arm.upper[:6],
                    arm.margin,
                    arm.max_acceleration[:6],
                    arm.max_jerk[:6],
                )
            )
            for arm in cell.arms
        )
        self._scale = tuple(
            tuple(2.0 / (limits.inner[1] - limits.inner[0]) for limits in arm) for arm in self._arms
        )

    def margin(self, cycle: Cycle) -> float:
        """Distance to the nearest limit less margin, as a part of half the range."""
        gaps, half = [1.0], self._half_period
        for track, arm, scales in zip(cycle.tracks, self._arms, self._scale, strict=True):
            motion = zip(track.asked_q, track.asked_v, track.asked_a, arm, scales, strict=False)
            for index, (q, v, a, joint, scale) in enumerate(motion):
                low, high = joint.inner
                gap = q - low if q - low < high - q else high - q
                # No stop is longer than this, a reversal included (see docs/safety.md).
                jolt = abs(a) * joint.unjerk
                fastest = abs(v + a * half) + 0.5 * jolt * abs(a)
                reach = fastest * (jolt + fastest * joint.quadratic + joint.steady)
                if gap < reach and self._is_leaving(track, index):
                    return -1.0
                gaps.append(gap * scale)
        return max(min(gaps), 0.0)

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict a joint that leaves its limits."""
        for track, arm in zip(cycle.tracks, self._arms, strict=True):
            for index, joint in enumerate(arm):
                if self._is_leaving(track, index):
                    q = track.asked_q[index]
                    low, high = joint.inner
                    limit = low if q - low < high - q else high
                    yield Verdict(self.id, Action.HOLD, track.index, index, q, limit)

    def _is_leaving(self, track: ArmTrack, index: int) -> bool:
        """Outside and not coming back, or moving such that a stop would end outside."""
        joint = self._arms[track.index][index]
        q, v, a = track.asked_q[index], track.asked_v[index], track.asked_a[index]
        low, high = joint.inner
        if (q < low and v < 0.0) or (q > high and v > 0.0):
            return True
        stop = JointStop(q, v + a * self._half_period, a, joint.acceleration, joint.jerk)
        first, last = stop.extent()
        hard_low, hard_high = joint.hard
        return first < min(hard_low, q) or last > max(hard_high, q)
