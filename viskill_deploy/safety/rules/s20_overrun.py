"""S20: the control loop keeps its period."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import ROUNDING, CellEnvelope
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.watchdog import LOST_S

PERIODS = 3.0
"""Two missed cycles are jitter of a general operating system; a third is an overrun."""
TOO_MANY, WITHIN_S = 3, 1.0
"""Three in a second: the machine is overloaded."""


class Rule:
    """WARN at an overrun; HOLD at the third in a second, and at one as long as a lost heartbeat.

    After that long a watchdog would have held the arms, and a robot has forgotten its speed.
    """

    id: ClassVar[str] = "S20"
    needs: ClassVar[Needs] = Needs.NOTHING

    def __init__(self, cell: CellEnvelope) -> None:
        self._limit = PERIODS * cell.period + ROUNDING
        self._overruns: deque[float] = deque(maxlen=TOO_MANY)

    def margin(self, cycle: Cycle) -> float:
        """One minus the time since the last cycle as a part of what is allowed."""
        if cycle.dt > self._limit:
            self._overruns.append(cycle.now)
        return 1.0 - cycle.dt / self._limit

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """The time since the last cycle, s."""
        recent = [at for at in self._overruns if cycle.now - at <= WITHIN_S]
        is_too_much = len(recent) >= TOO_MANY or cycle.dt >= LOST_S
        action = Action.HOLD if is_too_much else Action.WARN
        yield Verdict(self.id, action, value=cycle.dt, limit=self._limit)
