"""S03: setpoints stay inside the joint limits less a margin, and so does the stop from each."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.ranges import Ranges
from viskill_deploy.safety.reach import Reach
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.track import ArmTrack


class Rule:
    """HOLD on the way out; coming back in, or staying, passes.

    A setpoint passes only if the gate could still stop before the hard limit: the margin alone
    would be crossed within 5 ms at full insertion speed. A plan that itself comes to rest inside
    the limits, with less acceleration and jerk than the gate's stop has, never meets this.
    """

    id: ClassVar[str] = "S03"
    needs: ClassVar[Needs] = Needs.REQUEST

    def __init__(self, cell: CellEnvelope) -> None:
        self._arms = cell.arms
        self._inner = tuple(
            Ranges(
                [low + margin for low, margin in zip(arm.lower, arm.margin, strict=False)],
                [high - margin for high, margin in zip(arm.upper, arm.margin, strict=False)],
            )
            for arm in cell.arms
        )
        self._reaches = tuple(Reach(arm, cell.period) for arm in cell.arms)
        # Twice, because half the range here is before the margin is taken off.
        self._ramps = tuple(
            max(
                4.0 * v / (b - a)
                for v, a, b in zip(arm.max_speed, arm.lower, arm.upper, strict=True)
            )
            for arm in cell.arms
        )

    def margin(self, cycle: Cycle) -> float:
        """Distance to the nearest limit less margin, as a part of half the range."""
        parts = []
        for track, inner, reach, ramp in zip(
            cycle.tracks, self._inner, self._reaches, self._ramps, strict=True
        ):
            part = inner.farthest(track.asked_q)
            parts.append(part)
            w, time = reach.speed_and_time(track.fastest, track.sharpest)
            is_near = part + w * ramp * time > 1.0
            if is_near and any(
                self._is_leaving(track, joint) for joint in range(len(track.envelope.margin))
            ):
                return -1.0
        return max(1.0 - max(parts), 0.0)

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict a joint that leaves its limits."""
        for track, inner in zip(cycle.tracks, self._inner, strict=True):
            for joint in range(len(track.envelope.margin)):
                if self._is_leaving(track, joint):
                    q = track.asked_q[joint]
                    limit = inner.nearest(joint, q)
                    yield Verdict(self.id, Action.HOLD, track.index, joint, q, limit)

    def _is_leaving(self, track: ArmTrack, joint: int) -> bool:
        """Outside and not coming back, or moving such that a stop would end outside."""
        arm, inner = self._arms[track.index], self._inner[track.index]
        q = track.asked_q[joint]
        step = track.asked_step[joint]
        if (inner.is_below(joint, q) and step < 0.0) or (inner.is_above(joint, q) and step > 0.0):
            return True
        first, last = track.asked_extent(joint)
        return first < min(arm.lower[joint], q) or last > max(arm.upper[joint], q)
