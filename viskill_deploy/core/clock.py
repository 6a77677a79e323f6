"""The only reader of time. Control code takes `now` as an argument and never asks the system."""

from __future__ import annotations

import time
from typing import Protocol


class Clock(Protocol):
    """Seconds on a scale that never jumps."""

    def now(self) -> float:
        """Seconds since an arbitrary start."""
        ...

    def sleep_until(self, deadline_s: float) -> float:
        """Waits for an absolute time and returns the time at which it woke."""
        ...


class MonotonicClock:
    """The machine's monotonic clock: wall-clock jumps do not touch it."""

    def now(self) -> float:
        """Seconds since the machine started."""
        return time.monotonic()

    def sleep_until(self, deadline_s: float) -> float:
        """Sleeps to an absolute deadline; returns at once if it has passed."""
        remaining = deadline_s - time.monotonic()
        if remaining > 0:
            time.sleep(remaining)
        return time.monotonic()


class SteppedClock:
    """Simulated time, moved on by whoever steps the simulator. Also the fake clock of the tests."""

    def __init__(self, start_s: float = 1.0) -> None:
        self._now = start_s

    def now(self) -> float:
        """Simulated seconds."""
        return self._now

    def advance(self, dt_s: float) -> None:
        """Moves time on by `dt_s` seconds."""
        self._now += dt_s

    def sleep_until(self, deadline_s: float) -> float:
        """Jumps to the deadline."""
        self._now = max(self._now, deadline_s)
        return self._now


def wall_time() -> float:
    """Unix time in seconds, for file names and records only, never for control."""
    return time.time()


def wall_ns() -> int:
    """Unix time in nanoseconds, for stamps that other computers read, never for control."""
    return time.time_ns()
