"""S16: when the line found no solution, nothing unsolved goes out."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.rule_base import Needs

IN_A_ROW = 3
"""One miss may be a bad target; three are a broken solver."""


class Rule:
    """HOLD at the first cycle without a solution, FAULT at the third in a row.

    While the gate stops or holds, a request without setpoints and without a failure means that
    nobody asks for anything, and counts as nothing.
    """

    id: ClassVar[str] = "S16"
    needs: ClassVar[Needs] = Needs.NOTHING

    def __init__(self, cell: CellEnvelope) -> None:
        self._missed = 0

    def margin(self, cycle: Cycle) -> float:
        """One minus the misses in a row."""
        request = cycle.request
        is_idle = cycle.is_stopping and not request.failure
        if request.setpoints is not None or is_idle:
            self._missed = 0
            return 1.0
        self._missed += 1
        return -float(self._missed)

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """The number of misses against the number that makes a fault."""
        action = Action.FAULT if self._missed >= IN_A_ROW else Action.HOLD
        yield Verdict(self.id, action, value=float(self._missed), limit=float(IN_A_ROW))
