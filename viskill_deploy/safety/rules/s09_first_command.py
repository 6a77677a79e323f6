"""S09: the first setpoint after arming or resuming is where the driver already is."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import ROUNDING, CellEnvelope
from viskill_deploy.safety.rule_base import Needs


class Rule:
    """HOLD, which at the start means that nothing moves."""

    id: ClassVar[str] = "S09"
    needs: ClassVar[Needs] = Needs.REQUEST

    def __init__(self, cell: CellEnvelope) -> None:
        self._limits = tuple(arm.first_command for arm in cell.arms)

    def margin(self, cycle: Cycle) -> float:
        """One minus the largest distance as a part of what is allowed; 1.0 later on."""
        if not cycle.is_first:
            return 1.0
        return 1.0 - max(part for _, _, _, _, part in self._distances(cycle))

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict a joint that would start with a jerk."""
        for arm, joint, distance, limit, part in self._distances(cycle):
            if part > 1.0:
                yield Verdict(self.id, Action.HOLD, arm, joint, distance, limit)

    def _distances(self, cycle: Cycle) -> Iterator[tuple[int, int, float, float, float]]:
        for track, arm, limits in zip(cycle.tracks, cycle.state.arms, self._limits, strict=True):
            for joint, limit in enumerate(limits):
                distance = abs(track.asked.jp[joint] - arm.setpoint_jp[joint])
                yield track.index, joint, distance, limit, distance / limit * (1.0 - ROUNDING)
