"""S05: joint speed, cycle by cycle and over a window of true time."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from operator import mul
from typing import ClassVar

from viskill_deploy.core.types import Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import ROUNDING, CellEnvelope
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.scaling import scale_or_hold

WINDOW_S = 0.25
"""Long enough that 3 ms of jitter cannot trip it; a tip at the run's speed moves 13 mm in it."""


class Rule:
    """SCALE up to 1.2 times the limit, HOLD above.

    One cycle is judged by the nominal period: setpoints are samples of one time base, and dividing
    by a jittering clock would call a steady motion fast. The window is judged by true time, which
    is what finds a loop that runs too fast or sends in bursts; it sums the largest part of its
    limit that any joint uses in each cycle.
    """

    id: ClassVar[str] = "S05"
    needs: ClassVar[Needs] = Needs.REQUEST

    def __init__(self, cell: CellEnvelope) -> None:
        self._period = cell.period
        self._limits = tuple(arm.max_speed[:-1] for arm in cell.arms)
        self._inverse = tuple(
            tuple((1.0 - ROUNDING) / x for x in limits) for limits in self._limits
        )
        self._past: deque[tuple[float, float]] = deque()
        self._base: tuple[float, float]
        self._sum: float
        self._window: float

    def margin(self, cycle: Cycle) -> float:
        """One minus the largest speed as a part of its limit."""
        largest = max([track.fastest for track in cycle.tracks])
        self._window = self._over_window(cycle, largest)
        along: list[float] = [
            max(map(mul, map(abs, track.asked.jv), inverse))
            for track, inverse in zip(cycle.tracks, self._inverse, strict=True)
        ]
        return 1.0 - max(largest, self._window, *along)

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict a joint, by differences or by the velocity sent along; one for the cell."""
        for track, limits, inverse in zip(cycle.tracks, self._limits, self._inverse, strict=True):
            for joint, limit in enumerate(limits):
                part = max(track.speed[joint], abs(track.asked.jv[joint]) * inverse[joint])
                yield from scale_or_hold(self.id, track.index, joint, part, limit)
        yield from scale_or_hold(self.id, -1, -1, self._window, 1.0)

    def _over_window(self, cycle: Cycle, largest: float) -> float:
        """Way of the last 250 ms as a part of what full speed would make of them."""
        now, past = cycle.now, self._past
        if cycle.is_first or not past:
            past.clear()
            self._base, self._sum = (now - self._period, 0.0), 0.0
        self._sum += largest
        past.append((now, self._sum))
        while past[0][0] <= now - WINDOW_S:
            self._base = past.popleft()
        then, before = self._base
        return (self._sum - before) * self._period / max(now - then, WINDOW_S)
