"""The watchdog: what it shares with the runtime, and when it steps in. No input, no output here.

A process of its own looks at the runtime's heartbeat. When that stops, it holds the arms and then
takes their power, by a way of its own to the robot. The gate looks at the watchdog in the same
page of memory (S25, S26), so neither can be lost without the other acting.
"""

from __future__ import annotations

import enum
import mmap
from math import inf
from typing import Final

LOST_S: Final = 0.05
"""Without a heartbeat for this long the arms are held: 12 control periods at 250 Hz. What was sent
last leads a tip at 50 mm/s no farther than 2.5 mm in that time, if the robot goes on with it."""

DISABLE_S: Final = 0.5
"""Without one for this long the power is taken: held arms are at rest by then."""

RELEASED: Final = 0.0
"""In the place of a heartbeat: nothing is to move, so none is expected. A fresh page says so."""


class Heartbeat:
    """One page of memory, three numbers, no lock.

    Each number has one writer. It is stored and read as one aligned word of eight bytes, so nobody
    waits and nobody sees half of one. Times are of the machine's monotonic clock, s, which is the
    same in all processes.

    Args:
        descriptor: an open file of at least `SIZE` bytes, shared with the other process.
    """

    SIZE: Final = 24
    _BEAT, _WATCHED, _STEPPED_IN = range(3)

    def __init__(self, descriptor: int) -> None:
        self._page = mmap.mmap(descriptor, self.SIZE)
        self._words = memoryview(self._page).cast("d")

    @property
    def beat_s(self) -> float:
        """When the runtime last finished a cycle; `RELEASED` when nothing is to move."""
        return self._words[self._BEAT]

    @beat_s.setter
    def beat_s(self, value: float) -> None:
        self._words[self._BEAT] = value

    @property
    def watched_s(self) -> float:
        """When the watchdog last looked; 0.0 before it did."""
        return self._words[self._WATCHED]

    @watched_s.setter
    def watched_s(self, value: float) -> None:
        self._words[self._WATCHED] = value

    @property
    def has_stepped_in(self) -> bool:
        """Whether the watchdog has held the arms."""
        return self._words[self._STEPPED_IN] != 0.0

    def step_in(self) -> None:
        """The watchdog says that it holds the arms. Nothing takes that back."""
        self._words[self._STEPPED_IN] = 1.0

    def close(self) -> None:
        """Lets go of the page."""
        self._words.release()
        self._page.close()


class Reaction(enum.Enum):
    """What the watchdog does now."""

    WAIT = "wait"
    HOLD = "hold"
    DISABLE = "disable"


class Watchdog:
    """Decides when to step in; having done so it never goes back, whatever beats again."""

    def __init__(self) -> None:
        self._disable_at = inf

    def look(self, beat_s: float, now: float, is_runtime_gone: bool) -> Reaction:
        """What to do now.

        Args:
            beat_s: the runtime's last heartbeat, or `RELEASED`.
            now: the same clock, read after the heartbeat, s.
            is_runtime_gone: its process has ended without saying goodbye.
        """
        is_late = beat_s != RELEASED and not 0.0 <= now - beat_s < LOST_S  # NaN is late
        if self._disable_at == inf:
            if not (is_late or is_runtime_gone):
                return Reaction.WAIT
            self._disable_at = now + DISABLE_S - LOST_S
        return Reaction.HOLD if now < self._disable_at else Reaction.DISABLE
