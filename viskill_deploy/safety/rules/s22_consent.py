"""S22: the operator agrees to motion, and is known to be there."""

from __future__ import annotations

from collections.abc import Iterator
from math import inf
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import ROUNDING, CellEnvelope
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.soundness import are_sound


class Rule:
    """HOLD at once when consent is withdrawn and after 200 ms of silence, STOP after 2 s without.

    A source that repeats its word is believed while the word is fresh. One that speaks at changes
    only is believed while itself and the arms' feedback are alive: what went dead might have had
    news. Consent has to come from the source that it came from when the run began or went on.
    """

    id: ClassVar[str] = "S22"
    needs: ClassVar[Needs] = Needs.STATE

    def __init__(self, cell: CellEnvelope) -> None:
        self._hold, self._stop = cell.consent_hold + ROUNDING, cell.consent_stop + ROUNDING
        self._source: str
        self._age, self._good_at = inf, -inf

    def margin(self, cycle: Cycle) -> float:
        """One minus the age of the operator's word as a part of the age that holds."""
        inputs = cycle.state.inputs
        if cycle.is_first:
            self._source = inputs.consent_source
        is_said = inputs.consent is True and inputs.consent_source == self._source
        self._age = _age(cycle) if is_said else inf
        if self._age <= self._hold:
            self._good_at = cycle.now - self._age
        return 1.0 - min(self._age / self._hold, 2.0)

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """Time without consent, s; the limit is 0 when it was withdrawn."""
        is_silent, without = self._age < inf, cycle.now - self._good_at
        without = max(without, self._age) if is_silent else without
        if without > self._stop:
            yield Verdict(self.id, Action.STOP, value=without, limit=self._stop)
        else:
            limit = self._hold if is_silent else 0.0
            yield Verdict(self.id, Action.HOLD, value=without, limit=limit)


def _age(cycle: Cycle) -> float:
    """Age of the oldest thing that the consent rests on, s; ahead of the clock is as bad.

    Infinite when a stamp is no number.
    """
    inputs = cycle.state.inputs
    stamps = [inputs.consent_stamp_s]
    if inputs.consent_is_streamed is not True:
        stamps = [inputs.consent_alive_s, *(arm.stamp_s for arm in cycle.state.arms)]
    if not are_sound((inputs.consent_stamp_s, *stamps)):
        return inf
    return max([abs(cycle.now - stamp) for stamp in stamps])
