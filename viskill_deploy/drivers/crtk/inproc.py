"""CRTK in one process, without any middleware: for stepped simulation and unit tests.

A message arrives while it is being published. What is latched is remembered for who comes late.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from viskill_deploy.core.clock import Clock
from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.crtk.messages import NANO
from viskill_deploy.drivers.crtk.transport import M, Q, R, TransportName

Ear = Callable[[Any, float], None]
START_NS = 1_700_000_000 * NANO
"""Where stamps begin: never zero, which means "no data"."""


@dataclass
class _Line:
    """One topic."""

    message: type[Any]
    ears: list[tuple[Inproc, Ear]] = field(default_factory=list)
    mouths: list[Inproc] = field(default_factory=list)
    latched: Any = None


class Exchange:
    """What the nodes of one simulated network share.

    Args:
        clock: its time.
    """

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.lines: dict[str, _Line] = {}
        self.services: dict[str, Callable[[Any], Any]] = {}

    def line(self, topic: str, message: type[Any]) -> _Line:
        """The topic, opened when there is none yet.

        Raises:
            DriverError: it carries something else.
        """
        line = self.lines.setdefault(topic, _Line(message))
        if line.message is not message:
            raise DriverError(f"{topic} carries {line.message.__name__}, not {message.__name__}")
        return line

    def call(self, name: str, request: Any) -> Any:
        """The answer of a service."""
        return self.services[name](request)


class Inproc:
    """One node; it is a `Transport`.

    Args:
        exchange: the network it is on.
    """

    name: TransportName = "inproc"
    has_services = True

    def __init__(self, exchange: Exchange) -> None:
        self._exchange, self._is_open = exchange, True

    def publisher(
        self, topic: str, message: type[M], is_latched: bool = False
    ) -> Callable[[M], None]:
        """What publishes on a topic."""
        line = self._exchange.line(topic, message)
        line.mouths.append(self)

        def publish(word: M) -> None:
            if not self._is_open:
                raise DriverError(f"{topic}: this node is closed")
            if type(word) is not message:
                raise DriverError(f"{topic} carries {message.__name__}, not {type(word).__name__}")
            if is_latched:
                line.latched = word
            now = self._exchange.clock.now()
            for _, hear in tuple(line.ears):
                hear(word, now)

        return publish

    def subscribe(
        self,
        topic: str,
        message: type[M],
        hear: Callable[[M, float], None],
        is_latched: bool = False,
        kept: int = 1,
    ) -> None:
        """Calls `hear` for all that comes, and at once with what is latched; nothing waits."""
        del kept
        line = self._exchange.line(topic, message)
        line.ears.append((self, hear))
        if is_latched and line.latched is not None:
            hear(line.latched, self._exchange.clock.now())

    def serve(
        self, name: str, request: type[Q], response: type[R], answer: Callable[[Q], R]
    ) -> None:
        """Answers a service."""
        del request, response
        self._exchange.services[name] = answer

    def peers(self, topic: str) -> int:
        """How many others are on the topic, on the side that we are not on."""
        line = self._exchange.lines.get(topic)
        if line is None:
            return 0
        if self in line.mouths:
            return sum(node is not self for node, _ in line.ears)
        return sum(node is not self for node in line.mouths)

    def stamp_ns(self) -> int:
        """The exchange's time, since some day in 2023."""
        return START_NS + round(self._exchange.clock.now() * NANO)

    def close(self) -> None:
        """Leaves the network; what it latched is gone with it."""
        self._is_open = False
        for line in self._exchange.lines.values():
            line.ears = [ear for ear in line.ears if ear[0] is not self]
            if self in line.mouths:
                line.mouths, line.latched = [m for m in line.mouths if m is not self], None
