"""S04: measured joints are inside their hard limits, but for a little slack."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import ROUNDING, CellEnvelope
from viskill_deploy.safety.rule_base import Needs


class Rule:
    """FAULT: an arm beyond its mechanical limits is not the arm of the model."""

    id: ClassVar[str] = "S04"
    needs: ClassVar[Needs] = Needs.STATE

    def __init__(self, cell: CellEnvelope) -> None:
        self._arms = tuple(
            tuple(
                (0.5 * (low + high), (1.0 - ROUNDING) / (0.5 * (high - low) + arm.measured_slack))
                for low, high in zip(arm.lower[:6], arm.upper[:6], strict=True)
            )
            for arm in cell.arms
        )

    def margin(self, cycle: Cycle) -> float:
        """Distance to the nearest limit, as a part of half the range."""
        parts = [
            abs(q - middle) * inverse
            for arm, limits in zip(cycle.state.arms, self._arms, strict=True)
            for q, (middle, inverse) in zip(arm.measured_jp, limits, strict=True)
        ]
        return 1.0 - max(parts)

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict a joint outside."""
        for index, (arm, limits) in enumerate(zip(cycle.state.arms, self._arms, strict=True)):
            for joint, (q, (middle, inverse)) in enumerate(
                zip(arm.measured_jp, limits, strict=True)
            ):
                if abs(q - middle) * inverse > 1.0:
                    limit = middle + (1.0 if q > middle else -1.0) / inverse
                    yield Verdict(self.id, Action.FAULT, index, joint, q, limit)
