"""S07: joint jerk, by third differences of what is sent."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from viskill_deploy.core.types import Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.scaling import scale_or_hold


class Rule:
    """SCALE up to 1.2 times the limit, HOLD above; the jaw is one of the joints.

    A third difference is the mean jerk of three periods, so no motion within the limit is called
    beyond it. The supervisor holds the gate's own stop against the same limit.
    """

    id: ClassVar[str] = "S07"
    needs: ClassVar[Needs] = Needs.REQUEST

    def __init__(self, cell: CellEnvelope) -> None:
        self._limits = tuple(arm.max_jerk for arm in cell.arms)

    def margin(self, cycle: Cycle) -> float:
        """One minus the largest jerk as a part of its limit."""
        return 1.0 - max([track.jerkiest for track in cycle.tracks])

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict a joint over its limit."""
        for track, limits in zip(cycle.tracks, self._limits, strict=True):
            for joint, (part, limit) in enumerate(zip(track.jerk, limits, strict=True)):
                yield from scale_or_hold(self.id, track.index, joint, part, limit)
