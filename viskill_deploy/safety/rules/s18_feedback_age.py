"""S18: feedback is fresh by the driver's clock, and alive while the arm is told to move."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from viskill_deploy.core.types import Action, Joints, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import ROUNDING, CellEnvelope
from viskill_deploy.safety.rule_base import Needs

HOLD_S, HOLD_PERIODS = 0.05, 5
"""2.5 mm at the run's speed; a few lost messages."""
FAULT_S, FAULT_PERIODS = 0.1, 10
MOVED = (0.005, 0.0005)
"""rad, m. A setpoint that has moved this far shows in any encoder."""


class _Freeze:
    """Since when one arm's measurement has not changed by a bit, and the setpoint then."""

    __slots__ = ("measured", "sent", "since")

    def __init__(self) -> None:
        self.measured: Joints = ()
        self.sent: Joints
        self.since: float


class Rule:
    """HOLD after 50 ms or 5 feedback periods, FAULT after twice that, whichever is longer."""

    id: ClassVar[str] = "S18"
    needs: ClassVar[Needs] = Needs.STATE

    def __init__(self, cell: CellEnvelope) -> None:
        self._hold = tuple(
            max(HOLD_S, HOLD_PERIODS * arm.feedback_period) + ROUNDING for arm in cell.arms
        )
        self._fault = tuple(
            max(FAULT_S, FAULT_PERIODS * arm.feedback_period) + ROUNDING for arm in cell.arms
        )
        self._far = tuple(tuple(MOVED[slides] for slides in arm.slides) for arm in cell.arms)
        self._freezes = tuple(_Freeze() for _ in cell.arms)

    def margin(self, cycle: Cycle) -> float:
        """One minus the oldest feedback as a part of the age that holds."""
        parts, now = [], cycle.now
        for arm, track, freeze, hold in zip(
            cycle.state.arms, cycle.tracks, self._freezes, self._hold, strict=True
        ):
            if arm.measured_jp != freeze.measured:
                freeze.measured, freeze.sent, freeze.since = arm.measured_jp, track.q, now
            parts.append(self._age(cycle, track.index) / hold)
        return 1.0 - max(parts)

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict an arm whose feedback is old or frozen; the value is its age, s."""
        for index, (hold, fault) in enumerate(zip(self._hold, self._fault, strict=True)):
            age = self._age(cycle, index)
            if age > fault:
                yield Verdict(self.id, Action.FAULT, index, -1, age, fault)
            elif age > hold:
                yield Verdict(self.id, Action.HOLD, index, -1, age, hold)

    def _age(self, cycle: Cycle, index: int) -> float:
        """Age of the stamp (a stamp ahead of the clock is as bad), or of frozen numbers, s."""
        now, freeze = cycle.now, self._freezes[index]
        age = abs(now - cycle.state.arms[index].stamp_s)
        frozen = now - freeze.since
        if frozen > self._hold[index] and self._moved(index, cycle.tracks[index].q):
            return max(frozen, age)
        return age

    def _moved(self, index: int, q: Joints) -> bool:
        pairs = zip(q, self._freezes[index].sent, self._far[index], strict=False)
        return any(abs(new - old) > far for new, old, far in pairs)
