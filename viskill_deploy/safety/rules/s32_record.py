"""S32 and S24: what others report to the gate: the recorder failed, the driver raised."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from viskill_deploy.core.types import Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.rule_base import Needs


class Rule:
    """What was reported, as it was reported: STOP without a record, FAULT for all else."""

    id: ClassVar[str] = "S32"
    needs: ClassVar[Needs] = Needs.NOTHING

    def __init__(self, cell: CellEnvelope) -> None:
        del cell  # no threshold

    def margin(self, cycle: Cycle) -> float:
        """1.0 while nobody reports anything."""
        return -1.0 if cycle.reports else 1.0

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """The reports."""
        yield from cycle.reports
