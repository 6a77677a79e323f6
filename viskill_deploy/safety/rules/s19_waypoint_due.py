"""S19: the next waypoint is there when the present segment ends."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import ROUNDING, CellEnvelope
from viskill_deploy.safety.rule_base import Needs

OVERDUE_S = 0.1
"""Half a policy step: the motion layer itself comes to rest sooner, so this means it hangs."""


class Rule:
    """HOLD: a slow or hung policy does not keep an arm moving."""

    id: ClassVar[str] = "S19"
    needs: ClassVar[Needs] = Needs.REQUEST

    def __init__(self, cell: CellEnvelope) -> None:
        del cell  # the threshold is one for all cells

    def margin(self, cycle: Cycle) -> float:
        """One minus the delay as a part of what is allowed."""
        overdue = cycle.now - cycle.request.waypoint_due_s - ROUNDING
        return 1.0 - max(overdue, 0.0) / OVERDUE_S

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """The delay in s."""
        overdue = cycle.now - cycle.request.waypoint_due_s
        yield Verdict(self.id, Action.HOLD, value=overdue, limit=OVERDUE_S)
