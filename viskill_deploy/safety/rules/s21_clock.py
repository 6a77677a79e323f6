"""S21: the driver's clock never goes back and does not leap."""

from __future__ import annotations

from collections.abc import Iterator
from math import isfinite
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.watchdog import DISABLE_S


class Rule:
    """FAULT: ages and deadlines mean nothing any more.

    Who was away for so long that a watchdog would have taken the power has not seen what happened.
    """

    id: ClassVar[str] = "S21"
    needs: ClassVar[Needs] = Needs.NOTHING

    def __init__(self, cell: CellEnvelope) -> None:
        del cell  # no threshold

    def margin(self, cycle: Cycle) -> float:
        """1.0 while time goes on."""
        return 1.0 if _goes_on(cycle) and cycle.dt < DISABLE_S else -1.0

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """The time given against the time known, or how far it leapt against what is allowed, s."""
        if _goes_on(cycle):
            yield Verdict(self.id, Action.FAULT, value=cycle.dt, limit=DISABLE_S)
        else:
            yield Verdict(self.id, Action.FAULT, value=cycle.given_now, limit=cycle.now)


def _goes_on(cycle: Cycle) -> bool:
    return isfinite(cycle.given_now) and cycle.given_now >= cycle.now
