"""S10: speed of the control point, by the gate's own kinematics."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import ROUNDING, CellEnvelope
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.scaling import scale_or_hold


class Rule:
    """SCALE up to 1.2 times the run's speed, HOLD above, STOP over the ceiling."""

    id: ClassVar[str] = "S10"
    needs: ClassVar[Needs] = Needs.REQUEST

    def __init__(self, cell: CellEnvelope) -> None:
        self._limit, self._ceiling = cell.tip_speed, cell.tip_speed_ceiling
        self._inverse = (1.0 - ROUNDING) / cell.tip_speed

    def margin(self, cycle: Cycle) -> float:
        """One minus the fastest control point as a part of the run's speed."""
        return 1.0 - max([track.point_speed for track in cycle.tracks]) * self._inverse

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict an arm that is too fast."""
        for track in cycle.tracks:
            speed = track.point_speed
            if speed * (1.0 - ROUNDING) > self._ceiling:
                yield Verdict(self.id, Action.STOP, track.index, -1, speed, self._ceiling)
            else:
                part = speed * self._inverse
                yield from scale_or_hold(self.id, track.index, -1, part, self._limit)
