"""CRTK over plain DDS: what ROS 2 sends, without a ROS installation (CycloneDDS).

Meets nodes of any ROS 2 whose middleware is a DDS. It has no services, and `ros2 node list` does
not show it.
"""

from __future__ import annotations

import atexit
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any
from weakref import WeakValueDictionary

from cyclonedds.core import (
    DDSException,
    GuardCondition,
    InstanceState,
    Policy,
    Qos,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from viskill_deploy.core.clock import MonotonicClock, wall_ns
from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.crtk.cdr import decoder, encoder
from viskill_deploy.drivers.crtk.dds_types import carrier
from viskill_deploy.drivers.crtk.interfaces import cyclone_settings, is_loopback
from viskill_deploy.drivers.crtk.loopback_only import confine
from viskill_deploy.drivers.crtk.transport import EVENTS_KEPT, M, Q, R, TransportName, hand_over

RETRIES_S = (0.01, 0.05, 0.1)
"""How long a topic that was refused is left alone before it is tried again, and how often."""


@dataclass
class _Shared:
    """A domain of this process, which is closed when the last node has left."""

    domain: Any
    interface: str


_SHARED: WeakValueDictionary[int, _Shared] = WeakValueDictionary()


@dataclass
class _Ear:
    """One subscription."""

    topic: str
    reader: Any
    decode: Callable[[bytes], Any]
    hear: Callable[[Any, float], None]


@dataclass
class _Topics:
    """What a node has opened, by topic; `order` has all ears, those first that often hear."""

    topics: dict[str, tuple[type[Any], Any]] = field(default_factory=dict)
    writers: dict[str, list[Any]] = field(default_factory=dict)
    ears: dict[str, list[_Ear]] = field(default_factory=dict)
    order: list[_Ear] = field(default_factory=list)


class Dds:
    """One node; it is a `Transport`.

    Args:
        domain: ROS_DOMAIN_ID of the robot.
        interface: address of this machine to speak on, 127.0.0.1 to stay on it; "" leaves the
            choice to CycloneDDS and its CYCLONEDDS_URI.

    Raises:
        DriverError: there is no such interface, or this process is in that domain on another.
    """

    name: TransportName = "dds"
    has_services = False

    def __init__(self, domain: int = 0, interface: str = "") -> None:
        self._clock, self._opened, self._is_open = MonotonicClock(), _Topics(), True
        try:
            self._shared: _Shared | None = _shared(domain, interface)
            self._node = DomainParticipant(domain)
            self._bell, self._set = GuardCondition(self._node), WaitSet(self._node)
        except DDSException as error:
            where = interface or "any interface"
            raise DriverError(f"DDS domain {domain} on {where} does not open: {error}") from error
        self._set.attach(self._bell)
        self._thread = threading.Thread(target=self._listen, name="crtk-dds", daemon=True)
        self._thread.start()
        atexit.register(self.close)

    def publisher(
        self, topic: str, message: type[M], is_latched: bool = False
    ) -> Callable[[M], None]:
        """What publishes on a topic; a full buffer is an error at once, never a wait."""
        writer = DataWriter(self._node, self._topic(topic, message), _qos(is_latched))
        self._opened.writers.setdefault(topic, []).append(writer)
        encode, box = encoder(message), writer.data_type

        def publish(word: M) -> None:
            if not self._is_open:
                raise DriverError(f"{topic}: this node is closed")
            if type(word) is not message:
                raise DriverError(f"{topic} carries {message.__name__}, not {type(word).__name__}")
            try:
                writer.write(box(encode(word)))
            except DDSException as error:
                raise DriverError(f"{topic} was not sent; is the network up? {error}") from error

        return publish

    def subscribe(
        self,
        topic: str,
        message: type[M],
        hear: Callable[[M, float], None],
        is_latched: bool = False,
        kept: int = 1,
    ) -> None:
        """Calls `hear` from this node's thread for all that comes."""
        reader = DataReader(self._node, self._topic(topic, message), _qos(is_latched, kept))
        ear = _Ear(topic, reader, decoder(message), hear)
        self._opened.ears.setdefault(topic, []).append(ear)
        self._opened.order.append(ear)
        self._set.attach(ReadCondition(reader, SampleState.Any | ViewState.Any | InstanceState.Any))
        self._bell.set(True)

    def serve(
        self, name: str, request: type[Q], response: type[R], answer: Callable[[Q], R]
    ) -> None:
        """Never: each ROS 2 middleware says in its own way which request an answer is for.

        Raises:
            DriverError: always.
        """
        raise DriverError(f"{name}: plain DDS has no services; use the transport ros2 for them")

    def peers(self, topic: str) -> int:
        """How many others are on the topic, on the side that we are not on."""
        if not self._is_open:
            return 0
        writers, ears = self._opened.writers.get(topic), self._opened.ears.get(topic, [])
        if writers:
            return len(writers[0].get_matched_subscriptions()) - len(ears)
        return len(ears[0].reader.get_matched_publications()) if ears else 0

    def stamp_ns(self) -> int:
        """The machine's time of day."""
        return wall_ns()

    def close(self) -> None:
        """Leaves the domain."""
        if not self._is_open:
            return
        self._is_open = False
        atexit.unregister(self.close)
        self._bell.set(True)
        if threading.current_thread() is not self._thread:
            self._thread.join()
        for entity in (self._set, self._bell, self._node):
            entity.__del__()  # its only way out while somebody still holds a publisher
        self._shared = None

    def _topic(self, name: str, message: type[Any]) -> Any:
        if not self._is_open:
            raise DriverError(f"{name}: this node is closed")
        if name not in self._opened.topics:
            self._opened.topics[name] = message, self._made(name, message)
        carried, topic = self._opened.topics[name]
        if carried is not message:
            raise DriverError(f"{name} carries {carried.__name__}, not {message.__name__}")
        return topic

    def _made(self, name: str, message: type[Any]) -> Any:
        """A topic. CycloneDDS has been seen to refuse a good one; why is not known."""
        for wait_s in RETRIES_S:
            try:
                return Topic(self._node, f"rt{name}", carrier(message))
            except DDSException as error:
                refused = error
            self._clock.sleep_until(self._clock.now() + wait_s)
        raise DriverError(f"{name}: this topic does not open ({refused}); start again")

    def _listen(self) -> None:
        """The node's thread.

        It learns how many have something and not who: asks those first that often have, until it
        has found so many. More may have come meanwhile, so every other round asks all.
        """
        order, is_whole = self._opened.order, True
        while self._is_open:
            left = self._set.wait(duration(seconds=1))
            self._bell.take()
            was_whole, is_whole = is_whole, True
            for index, ear in enumerate(order):
                if left <= 0 and was_whole:
                    is_whole = False
                    break
                if self._take(ear):
                    left -= 1
                    if index:
                        order[index - 1 : index + 1] = ear, order[index - 1]

    def _take(self, ear: _Ear) -> bool:
        """Hands over what has come, but for what cannot be read; whether anything has."""
        samples = ear.reader.take(EVENTS_KEPT)
        now = self._clock.now()
        for sample in samples:
            if sample.sample_info.valid_data:
                hand_over(ear.topic, sample.data, ear.decode, ear.hear, now)
        return bool(samples)


def _qos(is_latched: bool, kept: int = 1) -> Qos:
    """As dVRK's bridge has it: RELIABLE, the newest only, but for events all that fits."""
    history = Policy.History.KeepLast(EVENTS_KEPT if is_latched else kept)
    lasting = Policy.Durability.TransientLocal if is_latched else Policy.Durability.Volatile
    return Qos(
        Policy.Reliability.Reliable(max_blocking_time=0),
        lasting,
        history,
        Policy.DurabilityService(0, Policy.History.KeepLast(1), -1, -1, -1),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )


def _shared(domain: int, interface: str) -> _Shared:
    """The domain on an interface, shared by the nodes of this process."""
    known = _SHARED.get(domain)
    if known is None:
        chosen = cyclone_settings(interface) if interface else os.environ.get("CYCLONEDDS_URI", "")
        opened = Domain(domain, chosen)
        if is_loopback(interface):
            confine(domain)
        known = _SHARED[domain] = _Shared(opened, interface)
    if known.interface != interface:
        raise DriverError(
            f"this process is in DDS domain {domain} on {known.interface or 'any interface'} "
            f"already; close that node before one on {interface or 'any'}"
        )
    return known
