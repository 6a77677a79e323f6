"""S21: the driver's clock never goes back."""

from __future__ import annotations

from collections.abc import Iterator
from math import isfinite
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.rule_base import Needs


class Rule:
    """FAULT: ages and deadlines mean nothing any more."""

    id: ClassVar[str] = "S21"
    needs: ClassVar[Needs] = Needs.NOTHING

    def __init__(self, cell: CellEnvelope) -> None:
        del cell  # no threshold

    def margin(self, cycle: Cycle) -> float:
        """1.0 while time goes on."""
        given = cycle.given_now
        return 1.0 if given >= cycle.now and isfinite(given) else -1.0

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """The time given against the time known, s."""
        yield Verdict(self.id, Action.FAULT, value=cycle.given_now, limit=cycle.now)
