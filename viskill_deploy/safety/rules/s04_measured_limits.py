"""S04: measured joints are inside their hard limits, but for a little slack."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.ranges import Ranges
from viskill_deploy.safety.rule_base import Needs


class Rule:
    """FAULT: an arm beyond its mechanical limits is not the arm of the model."""

    id: ClassVar[str] = "S04"
    needs: ClassVar[Needs] = Needs.STATE

    def __init__(self, cell: CellEnvelope) -> None:
        self._arms = tuple(
            Ranges(
                [low - arm.measured_slack for low in arm.lower[:-1]],
                [high + arm.measured_slack for high in arm.upper[:-1]],
            )
            for arm in cell.arms
        )

    def margin(self, cycle: Cycle) -> float:
        """Distance to the nearest limit, as a part of half the range."""
        arms = zip(cycle.state.arms, self._arms, strict=True)
        return 1.0 - max([ranges.farthest(arm.measured_jp) for arm, ranges in arms])

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict a joint outside."""
        for index, (arm, ranges) in enumerate(zip(cycle.state.arms, self._arms, strict=True)):
            for joint, part in enumerate(ranges.parts(arm.measured_jp)):
                if part > 1.0:
                    q = arm.measured_jp[joint]
                    limit = ranges.nearest(joint, q)
                    yield Verdict(self.id, Action.FAULT, index, joint, q, limit)
