"""The runtime's end of the watchdog, and the watch that the other process stands.

A driver brings the program of its watchdog (`loopback_watchdog` is one): it opens a way of its own
to the robot and calls `stand_watch`. The pipe to its standard input carries nothing. When the
runtime dies the pipe ends, and the watchdog knows at once; a runtime that hangs keeps the pipe open
and is found by its heartbeat.
"""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from math import inf
from typing import Protocol

from viskill_deploy.core.clock import Clock, MonotonicClock
from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import Inputs
from viskill_deploy.safety.watchdog import RELEASED, Heartbeat, Reaction, Watchdog

LOOK_S = 0.004
"""Between two looks: at most this is added to the watchdog's thresholds."""

START_TIMEOUT_S = 20.0
LAST_WORDS_S = 0.1
"""How long a watchdog with nobody left to watch goes on saying "disable": one could get lost."""


class Watch(Protocol):
    """What a session tells its watchdog, and what the watchdog tells the gate."""

    def beat(self, now: float) -> None:
        """A cycle is done. From the first one on, a missing beat stops the arms."""
        ...

    def release(self) -> None:
        """The arms are at rest and nothing is to move: no beat is expected until the next one."""
        ...

    def told(self, inputs: Inputs, now: float) -> Inputs:
        """`inputs` with the watchdog's newest word."""
        ...

    def close(self) -> None:
        """Ends the watch; may be called twice."""
        ...


class OwnTime:
    """The watch on a stepped cell: its time stands still without this process, and so does it."""

    def beat(self, now: float) -> None:
        """Nobody listens."""

    def release(self) -> None:
        """Nobody listens."""

    def told(self, inputs: Inputs, now: float) -> Inputs:
        """Says that all is well."""
        i = inputs  # not `replace`, which costs more than all else in this call
        said = (i.consent, i.consent_stamp_s, i.consent_source, i.estop)
        return Inputs(*said, now, False, i.consent_is_streamed, i.consent_alive_s)

    def close(self) -> None:
        """Nothing to end."""


class WatchProcess:
    """A watchdog in a process of its own; returns when it is watching.

    Args:
        module: the driver's program, run as `python -P -m module PAGE arguments…`: files that lie
            about in the present folder are none of its business.
        arguments: what it needs to find the robot.

    Attributes:
        process: the watchdog.

    Raises:
        DriverError: it did not begin to watch in time.
    """

    def __init__(self, module: str, arguments: Sequence[str]) -> None:
        page = os.memfd_create("viskill-heartbeat")
        try:
            os.ftruncate(page, Heartbeat.SIZE)
            self._heartbeat = Heartbeat(page)
            self.process = subprocess.Popen(
                [sys.executable, "-P", "-m", module, str(page), *arguments],
                stdin=subprocess.PIPE,
                pass_fds=(page,),
                start_new_session=True,  # a Ctrl-C is for the runtime, which still needs a watchdog
            )
        finally:
            os.close(page)
        self._is_open = True
        try:
            self._wait_until_watched(MonotonicClock())
        except DriverError:
            self.close()
            raise

    def beat(self, now: float) -> None:
        """A cycle is done."""
        self._heartbeat.beat_s = now

    def release(self) -> None:
        """Nothing is to move."""
        self._heartbeat.beat_s = RELEASED

    def told(self, inputs: Inputs, now: float) -> Inputs:
        """`inputs` with the watchdog's newest word, which `now` does not change."""
        heartbeat = self._heartbeat
        return replace(
            inputs,
            watchdog_stamp_s=heartbeat.watched_s,
            watchdog_stepped_in=heartbeat.has_stepped_in,
        )

    def close(self) -> None:
        """Ends the watchdog before it can take a goodbye for a death."""
        if not self._is_open:
            return
        self._is_open = False
        self.process.kill()
        self.process.wait()
        if self.process.stdin is not None:
            self.process.stdin.close()
        self._heartbeat.close()

    def _wait_until_watched(self, clock: Clock) -> None:
        deadline = clock.now() + START_TIMEOUT_S
        while self._heartbeat.watched_s == 0.0:
            if self.process.poll() is not None or clock.now() > deadline:
                raise DriverError(
                    "the watchdog does not watch; look for its message above, and start again"
                )
            clock.sleep_until(clock.now() + LOOK_S)


class Stopper(Protocol):
    """A way to a robot that can only stop it."""

    def hold(self) -> None:
        """Every arm stays where it is, and takes no setpoint until it is enabled again."""
        ...

    def disable(self) -> None:
        """Takes power from every arm."""
        ...

    def check(self) -> None:
        """Raises DriverError when the robot cannot be reached any more."""
        ...


def stand_watch(heartbeat: Heartbeat, stopper: Stopper, runtime: int, clock: Clock) -> None:
    """Watches until the runtime is gone and the arms have been without power for a while.

    A watchdog that has stepped in says so again at every look: nobody gets the arms back while
    this process lives.

    Args:
        heartbeat: the page shared with the runtime.
        stopper: the watchdog's own way to the robot.
        runtime: reading end of a pipe that the runtime holds open.
        clock: the machine's monotonic one.

    Raises:
        DriverError: the robot cannot be reached: ending is how the gate is told (S26).
    """
    watchdog, is_gone, end = Watchdog(), False, inf
    now = clock.now()
    while now < end:
        beat = heartbeat.beat_s
        now = clock.now()
        heartbeat.watched_s = now
        match watchdog.look(beat, now, is_gone):
            case Reaction.WAIT:
                stopper.check()
            case Reaction.HOLD:
                heartbeat.step_in()
                stopper.hold()
            case Reaction.DISABLE:
                stopper.disable()
                if is_gone and end == inf:
                    end = now + LAST_WORDS_S
        if is_gone:
            clock.sleep_until(now + LOOK_S)
        else:
            is_gone = bool(select.select([runtime], [], [], LOOK_S)[0])


def main(stopper: Stopper, page: int) -> None:
    """The rest of a watchdog's program, once it has its way to the robot.

    Args:
        stopper: the way to the robot.
        page: descriptor of the shared page.
    """
    heartbeat = Heartbeat(page)
    with contextlib.suppress(DriverError):
        stand_watch(heartbeat, stopper, sys.stdin.fileno(), MonotonicClock())
