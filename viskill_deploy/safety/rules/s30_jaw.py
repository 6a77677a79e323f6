"""S30: the jaw keeps its range and speed, and never drops what it holds."""

from __future__ import annotations

from collections.abc import Iterator
from math import inf
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import ROUNDING, CellEnvelope
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.track import ArmTrack

JAW = -1
"""The last axis."""
OPENS_RAD = 0.02
"""A grip is kept through this much: it is a fifth of a millimetre at the end of the fingers."""


class Rule:
    """HOLD.

    The opening is counted from the tightest grip since holding began, so that no slow creep gets
    past it. A request that does not say whether the jaw holds something counts as holding: to
    open, it has to say that it may.
    """

    id: ClassVar[str] = "S30"
    needs: ClassVar[Needs] = Needs.REQUEST

    def __init__(self, cell: CellEnvelope) -> None:
        self._range = tuple((arm.lower[JAW], arm.upper[JAW]) for arm in cell.arms)
        self._speed = tuple(arm.max_speed[JAW] for arm in cell.arms)
        self._jaw = tuple(len(arm.max_speed) - 1 for arm in cell.arms)
        self._grip = [inf] * len(cell.arms)

    def margin(self, cycle: Cycle) -> float:
        """One minus the worst of range, speed and opening, each as a part of its limit."""
        parts: list[float] = []
        for arm, track in enumerate(cycle.tracks):
            self._follow_grip(cycle, arm)
            parts += (self._speed_part(track), self._opening(cycle, arm) / OPENS_RAD)
            if self._is_leaving_range(cycle, arm):
                return -1.0
        return 1.0 - max(parts)

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict for each thing that is wrong with a jaw."""
        for arm, track in enumerate(cycle.tracks):
            jaw, limit = track.asked.jaw, self._speed[arm]
            part, opening = self._speed_part(track), self._opening(cycle, arm)
            if part > 1.0:
                yield Verdict(self.id, Action.HOLD, arm, self._jaw[arm], part * limit, limit)
            if opening > OPENS_RAD:
                yield Verdict(self.id, Action.HOLD, arm, self._jaw[arm], opening, OPENS_RAD)
            if self._is_leaving_range(cycle, arm):
                lower, upper = self._range[arm]
                bound = min(max(jaw, lower), upper)
                yield Verdict(self.id, Action.HOLD, arm, self._jaw[arm], jaw, bound)

    def _speed_part(self, track: ArmTrack) -> float:
        """The faster of difference and velocity sent along, as a part of the limit."""
        along = abs(track.asked.jaw_v) * (1.0 - ROUNDING) / self._speed[track.index]
        return max(track.speed[JAW], along)

    def _follow_grip(self, cycle: Cycle, arm: int) -> None:
        holding, may_open = cycle.request.holding, cycle.request.may_open_jaw
        if (holding and holding[arm] is False) or (may_open and may_open[arm] is True):
            self._grip[arm] = inf
        else:
            self._grip[arm] = min(self._grip[arm], cycle.tracks[arm].q[JAW])

    def _opening(self, cycle: Cycle, arm: int) -> float:
        """How much wider than the tightest grip the jaw is asked to be, rad; 0 when it may."""
        return max(cycle.tracks[arm].asked.jaw - self._grip[arm], 0.0) * (1.0 - ROUNDING)

    def _is_leaving_range(self, cycle: Cycle, arm: int) -> bool:
        lower, upper = self._range[arm]
        new, old = cycle.tracks[arm].asked.jaw, cycle.tracks[arm].q[JAW]
        return (new < lower - ROUNDING and new < old) or (new > upper + ROUNDING and new > old)
