"""S25: the watchdog has not had to step in for want of a heartbeat."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.rule_base import Needs


class Rule:
    """ESTOP: a runtime that was stopped or hung does not go on where it was.

    The arms were held, and perhaps powered off, while it was away.
    """

    id: ClassVar[str] = "S25"
    needs: ClassVar[Needs] = Needs.NOTHING

    def __init__(self, cell: CellEnvelope) -> None:
        del cell  # the watchdog has its own threshold

    def margin(self, cycle: Cycle) -> float:
        """1.0 when all is well; anything but the one good value is bad."""
        return 1.0 if cycle.state.inputs.watchdog_stepped_in is False else -1.0

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict for the cell."""
        yield Verdict(self.id, Action.ESTOP)
