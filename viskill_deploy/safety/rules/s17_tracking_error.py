"""S17: the arms are where they are told to be."""

from __future__ import annotations

from collections.abc import Iterator
from operator import mul, sub
from typing import ClassVar

from viskill_deploy.core.types import Action, ArmState, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import ROUNDING, CellEnvelope
from viskill_deploy.safety.rule_base import Needs

FAR = 2.0
"""Times the tolerance: no lag of a servo, something holds the arm or its encoder is wrong."""
REFILL = 0.25
"""Part of its time that an error gives back while it is away: one that comes and goes acts too."""


class Rule:
    """STOP on an error that is too large for too long; FAULT on twice as large, or a second time.

    Errors are measured positions against the setpoint sent last. The jaw is left out: what it
    holds keeps it open.
    """

    id: ClassVar[str] = "S17"
    needs: ClassVar[Needs] = Needs.STATE

    def __init__(self, cell: CellEnvelope) -> None:
        self._inverse = tuple(
            [(1.0 - ROUNDING) / error for error in arm.tracking] for arm in cell.arms
        )
        self._limits = tuple(arm.tracking for arm in cell.arms)
        self._time = tuple(arm.tracking_time + ROUNDING for arm in cell.arms)
        self._off = [0.0] * len(cell.arms)  # how long each arm has been off, and far off, s
        self._far_off = [0.0] * len(cell.arms)

    def margin(self, cycle: Cycle) -> float:
        """One minus the largest error as a part of the tolerance; then time, once that is up."""
        parts, over = [], []
        for index, arm in enumerate(cycle.state.arms):
            part = max(self._parts(cycle, index, arm))
            self._off[index] = _spent(self._off[index], cycle.dt, part > 1.0)
            self._far_off[index] = _spent(self._far_off[index], cycle.dt, part > FAR)
            parts.append(max(1.0 - part, 0.0))
            over.append(1.0 - self._off[index] / self._time[index])
        return min(over) if min(over) < 0.0 else min(parts)

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict an arm, on its worst joint: the error against the tolerance."""
        for index, arm in enumerate(cycle.state.arms):
            if self._off[index] > self._time[index]:
                parts = self._parts(cycle, index, arm)
                joint = parts.index(max(parts))
                is_fault = self._far_off[index] > self._time[index]
                is_fault = is_fault or self.id in cycle.stopped_before
                action = Action.FAULT if is_fault else Action.STOP
                limit = self._limits[index][joint]
                yield Verdict(self.id, action, index, joint, parts[joint] * limit, limit)

    def _parts(self, cycle: Cycle, index: int, arm: ArmState) -> list[float]:
        errors = map(abs, map(sub, arm.measured_jp, cycle.tracks[index].q))
        return list(map(mul, errors, self._inverse[index]))


def _spent(before: float, dt: float, is_off: bool) -> float:
    """Time off after another cycle, s."""
    return before + dt if is_off else max(before - REFILL * dt, 0.0)
