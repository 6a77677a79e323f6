"""What carries CRTK's messages: in this process, over ROS 1, over ROS 2, or over plain DDS.

A transport is thin: it moves the values of `messages` and knows nothing of arms.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, Literal, Protocol, TypeVar

M = TypeVar("M")
Q = TypeVar("Q")
R = TypeVar("R")

TransportName = Literal["inproc", "ros1", "ros2", "dds"]

LOG = logging.getLogger(__name__)

EVENTS_KEPT = 100
"""How many latched words dVRK's bridge keeps for who is slow; over ROS 2, also for who is late."""


def hand_over(topic: str, sample: Any, decode: Any, hear: Any, now_s: float) -> None:
    """Lets an ear hear one sample. One that cannot be read, or an ear that raises, is logged.

    The thread that listens must live: without it every topic would be deaf.
    """
    try:
        hear(decode(sample), now_s)
    except Exception:
        LOG.exception("%s: what came was dropped", topic)


class Transport(Protocol):
    """A node on some middleware.

    Attributes:
        name: which it is, for messages to people.
        has_services: whether `serve` can be called.
    """

    name: TransportName
    has_services: bool

    def publisher(
        self, topic: str, message: type[M], is_latched: bool = False
    ) -> Callable[[M], None]:
        """What publishes on a topic, such as "/PSM1/servo_jp". It never waits.

        Commands are RELIABLE, VOLATILE and KEEP_LAST 1 over ROS 2, as dVRK's subscribers want them.

        Raises:
            DriverError: when called after `close`, or the middleware refuses.
        """
        ...

    def subscribe(
        self,
        topic: str,
        message: type[M],
        hear: Callable[[M, float], None],
        is_latched: bool = False,
        kept: int = 1,
    ) -> None:
        """Calls `hear(message, received_s)`, perhaps in another thread, for all that comes.

        Of what comes while this thread is busy the newest `kept` are heard, oldest first; of what
        is latched, `EVENTS_KEPT`. How many is this side's own business: publishers match or not
        whatever it is.

        `received_s` is the machine's monotonic clock at the arrival (the clock given, in process).
        `hear` must be quick and raise nothing.
        """
        ...

    def serve(
        self, name: str, request: type[Q], response: type[R], answer: Callable[[Q], R]
    ) -> None:
        """Answers a service, perhaps in another thread; only where `has_services`."""
        ...

    def peers(self, topic: str) -> int:
        """How many are at the other end of a topic of ours: subscribers or publishers."""
        ...

    def stamp_ns(self) -> int:
        """Now, as messages are stamped: nanoseconds since 1970."""
        ...

    def close(self) -> None:
        """Leaves the middleware; may be called twice."""
        ...
