"""S26: the watchdog is watching."""

from __future__ import annotations

from collections.abc import Iterator
from math import inf
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import ROUNDING, CellEnvelope
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.watchdog import LOST_S


class Rule:
    """STOP: nobody would hold the arms if this process died now."""

    id: ClassVar[str] = "S26"
    needs: ClassVar[Needs] = Needs.NOTHING

    def __init__(self, cell: CellEnvelope) -> None:
        del cell  # the threshold is the watchdog's own, one for all cells

    def margin(self, cycle: Cycle) -> float:
        """One minus the time since it last looked as a part of what is allowed."""
        return 1.0 - _age(cycle) / (LOST_S + ROUNDING)

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """The time since it last looked, s."""
        yield Verdict(self.id, Action.STOP, value=_age(cycle), limit=LOST_S)


def _age(cycle: Cycle) -> float:
    """A time that is no number is infinitely old; one ahead of the clock is as bad as behind."""
    stamp = cycle.state.inputs.watchdog_stamp_s
    return abs(cycle.now - stamp) if isinstance(stamp, float) else inf
