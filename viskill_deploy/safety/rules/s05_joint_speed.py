"""S05: joint speed, cycle by cycle and over a window of true time."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from operator import add, mul, sub
from typing import ClassVar

from viskill_deploy.core.types import Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import ROUNDING, CellEnvelope
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.scaling import scale_or_hold

WINDOW_S = 0.25
"""Long enough that 3 ms of jitter cannot trip it, short enough that 13 mm is the farthest move."""


class Rule:
    """SCALE up to 1.2 times the limit, HOLD above.

    One cycle is judged by the nominal period: setpoints are samples of one time base, and dividing
    by a jittering clock would call a steady motion fast. The window is judged by true time, which
    is what finds a loop that runs too fast or sends in bursts.
    """

    id: ClassVar[str] = "S05"
    needs: ClassVar[Needs] = Needs.REQUEST

    def __init__(self, cell: CellEnvelope) -> None:
        self._period = cell.period
        self._inverse = tuple(
            tuple((1.0 - ROUNDING) / x for x in arm.max_speed[:6]) for arm in cell.arms
        )
        self._limits = tuple(arm.max_speed for arm in cell.arms)
        self._past: deque[tuple[float, list[float]]] = deque()
        self._base: tuple[float, list[float]] = (0.0, [])
        self._way: list[float] = []
        self._elapsed = WINDOW_S

    def margin(self, cycle: Cycle) -> float:
        """One minus the largest speed as a part of its limit."""
        parts = [self._window(cycle)]
        for track, inverse in zip(cycle.tracks, self._inverse, strict=True):
            parts += track.speed[:6]
            parts += map(mul, map(abs, track.asked.jv), inverse)
        return 1.0 - max(parts)

    def _window(self, cycle: Cycle) -> float:
        """Largest way of any joint over the window, as a part of what full speed would make."""
        now, past = cycle.now, self._past
        speed: list[float] = []
        for track in cycle.tracks:
            speed += track.speed
        if cycle.is_first or not self._way:
            past.clear()
            self._way = [0.0] * len(speed)
            self._base = (now - self._period, self._way)
        way = self._way = list(map(add, self._way, speed))
        past.append((now, way))
        start = now - WINDOW_S
        while past[0][0] <= start:
            self._base = past.popleft()
        then, before = self._base
        self._elapsed = max(now - then, WINDOW_S)
        return max(map(sub, way, before)) * self._period / self._elapsed

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict a joint, by the worst of its three speeds."""
        to_speed = self._period / self._elapsed
        window = list(map(sub, self._way, self._base[1]))
        for track, limits in zip(cycle.tracks, self._limits, strict=True):
            sent_along = (*track.asked.jv, 0.0)
            for joint, limit in enumerate(limits):
                way = window[7 * track.index + joint] * to_speed * limit
                by_cycle = abs(track.asked_v[joint]) if joint < 6 else 0.0
                value = max(by_cycle, abs(sent_along[joint]), way)
                yield from scale_or_hold(self.id, track.index, joint, value, limit)
