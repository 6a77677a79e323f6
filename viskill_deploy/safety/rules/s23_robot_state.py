"""S23: no emergency stop, and every arm enabled, homed and vouched for by its driver."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from viskill_deploy.core.types import Action, ArmState, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.rule_base import Needs


class Rule:
    """ESTOP on the emergency stop; FAULT on an arm that is not ready to be moved.

    Written so that anything but the one good value is bad.
    """

    id: ClassVar[str] = "S23"
    needs: ClassVar[Needs] = Needs.NOTHING

    def __init__(self, cell: CellEnvelope) -> None:
        del cell  # no threshold

    def margin(self, cycle: Cycle) -> float:
        """1.0 when all is well."""
        state = cycle.state
        return 1.0 if state.inputs.estop is False and all(map(is_able, state.arms)) else -1.0

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict for the emergency stop, one an arm that is not ready."""
        if cycle.state.inputs.estop is not False:
            yield Verdict(self.id, Action.ESTOP)
        for index, arm in enumerate(cycle.state.arms):
            if not is_able(arm):
                yield Verdict(self.id, Action.FAULT, index)


def is_able(arm: ArmState) -> bool:
    """The arm is enabled, homed, and its driver vouches for the sample."""
    return arm.operating_state == "ENABLED" and arm.is_homed is True and arm.valid is True
