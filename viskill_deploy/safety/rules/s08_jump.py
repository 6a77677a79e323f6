"""S08: no setpoint jumps away from the last one sent."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.rule_base import Needs

JUMP = 2.0
"""Times the way at full speed in one period: what the robot feels, however late the loop was."""


class Rule:
    """HOLD: a jump is an error of the line, not a fast motion."""

    id: ClassVar[str] = "S08"
    needs: ClassVar[Needs] = Needs.REQUEST

    def __init__(self, cell: CellEnvelope) -> None:
        self._limits = tuple(
            tuple(JUMP * speed * cell.period for speed in arm.max_speed) for arm in cell.arms
        )

    def margin(self, cycle: Cycle) -> float:
        """One minus the largest jump as a part of what is allowed."""
        return 1.0 - max([max(track.speed) for track in cycle.tracks]) / JUMP

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict a joint that jumps."""
        for track, limits in zip(cycle.tracks, self._limits, strict=True):
            for joint, part in enumerate(track.speed):
                if part > JUMP:
                    jump = abs(track.asked_step[joint])
                    yield Verdict(self.id, Action.HOLD, track.index, joint, jump, limits[joint])
