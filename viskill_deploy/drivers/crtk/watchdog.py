"""The watchdog of arms over CRTK, a process of its own with a node of its own.

It says nothing but `hold` and the state commands pause and disable. A dVRK holds its last setpoint
for ever when a client dies, but keeps that setpoint's velocity and takes the next one from anybody:
held and paused it is at rest and takes none.
"""

from __future__ import annotations

import argparse
import contextlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from typing import Final

from viskill_deploy.core import realtime
from viskill_deploy.core.clock import Clock, MonotonicClock
from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers import watch
from viskill_deploy.drivers.base import DISABLED, ENABLED
from viskill_deploy.drivers.crtk.messages import (
    Empty,
    Header,
    OperatingState,
    StringStamped,
    Time,
)
from viskill_deploy.drivers.crtk.opening import Network, open_transport
from viskill_deploy.drivers.crtk.transport import Transport
from viskill_deploy.drivers.watch import WatchProcess

MODULE: Final = "viskill_deploy.drivers.crtk.watchdog"
FIND_S: Final = 10.0
LOOK_S: Final = 0.02
AGAIN_S: Final = 0.02
"""How often a word without effect is said again."""


class _Words:
    """What can be said to one arm, and the state that it says it is in."""

    def __init__(self, arm: str, transport: Transport, clock: Clock) -> None:
        self.name, self._transport, self._clock = arm, transport, clock
        self.topics = [f"/{arm}/{name}" for name in ("hold", "state_command", "operating_state")]
        self._hold = transport.publisher(self.topics[0], Empty)
        self._command = transport.publisher(self.topics[1], StringStamped)
        self._state, self._stamp_ns = "", 0
        self._said_s: dict[str, float] = {}
        transport.subscribe(self.topics[2], OperatingState, self._hear, is_latched=True)

    def lost(self) -> str:
        """The first topic on which nobody is at the other end; "" when all are."""
        deaf = [topic for topic in self.topics if self._transport.peers(topic) == 0]
        return deaf[0] if deaf else "" if self._state else self.topics[2]

    def hold(self) -> None:
        """Stay, at rest, and from the next time on take no setpoint: a paused arm hears no hold."""
        was_told = "hold" in self._said_s
        self._say("hold", lambda: self._hold(Empty()))
        if was_told and self._state in {"", ENABLED}:
            self._say("pause", partial(self._ask, "pause"))

    def disable(self) -> None:
        """Let go of power."""
        if self._state != DISABLED:
            self._say("disable", partial(self._ask, "disable"))

    def _say(self, word: str, publish: Callable[[], None]) -> None:
        now = self._clock.now()
        if now - self._said_s.get(word, -AGAIN_S) >= AGAIN_S:
            self._said_s[word] = now
            with contextlib.suppress(DriverError):  # the other arm has to hear it all the same
                publish()

    def _ask(self, word: str) -> None:
        stamp = Time.of_ns(self._transport.stamp_ns())
        self._command(StringStamped(Header(stamp), word))

    def _hear(self, word: OperatingState, received_s: float) -> None:
        del received_s
        if word.header.stamp.ns >= self._stamp_ns:
            self._state, self._stamp_ns = word.state, word.header.stamp.ns


class CrtkStopper:
    """A way to dVRK arms that can only stop them; it is a `watch.Stopper`.

    Args:
        arms: their names.
        transport: a node of its own.
        clock: the machine's.
    """

    def __init__(self, arms: Sequence[str], transport: Transport, clock: Clock) -> None:
        self._clock, self._looked_s = clock, -LOOK_S
        self._arms = [_Words(arm, transport, clock) for arm in arms]

    def find(self) -> None:
        """Waits until every arm hears and is heard.

        Raises:
            DriverError: one does not, within 10 s; names the topic.
        """
        deadline = self._clock.now() + FIND_S
        while lost := self._lost():
            if self._clock.now() > deadline:
                raise DriverError(f"the watchdog finds nobody on {lost}; start the robot's program")
            self._clock.sleep_until(self._clock.now() + LOOK_S)

    def hold(self) -> None:
        """Every arm stays where it is, and takes no setpoint until it is resumed or enabled."""
        for arm in self._arms:
            arm.hold()

    def disable(self) -> None:
        """Takes power from every arm."""
        for arm in self._arms:
            arm.disable()

    def check(self) -> None:
        """Raises DriverError when an arm cannot be reached any more."""
        if self._clock.now() - self._looked_s < LOOK_S:
            return
        self._looked_s = self._clock.now()
        lost = self._lost()
        if lost:
            raise DriverError(f"the watchdog has lost {lost}; look at the robot's program")

    def _lost(self) -> str:
        return next(filter(None, [arm.lost() for arm in self._arms]), "")


def start_watch(arms: Sequence[str], transport: str, network: Network) -> WatchProcess:
    """Starts the watchdog.

    Args:
        arms: names of the arms.
        transport: name of the transport that they speak.
        network: where they are.

    Raises:
        DriverError: it did not find them in time.
    """
    return WatchProcess(MODULE, [transport, json.dumps(asdict(network)), *arms])


def main() -> None:
    """Entry point of the process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("page", type=int, help="descriptor of the page shared with the runtime")
    parser.add_argument("transport")
    parser.add_argument("network", help="Network, as JSON")
    parser.add_argument("arms", nargs="+")
    args = parser.parse_args()
    node = open_transport(args.transport, Network(**json.loads(args.network)))
    try:
        stopper = CrtkStopper(args.arms, node, MonotonicClock())
        stopper.find()
        realtime.prepare(realtime.WATCHDOG_PRIORITY)
        watch.main(stopper, args.page)
    finally:
        node.close()


if __name__ == "__main__":
    main()
