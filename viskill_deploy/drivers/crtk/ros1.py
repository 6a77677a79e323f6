"""CRTK over ROS 1 (rospy). A process is one node of ROS 1, however many of these it opens."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from typing import Any

import rosgraph
import rospy

from viskill_deploy.core.clock import MonotonicClock, wall_ns
from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.crtk.conversion import from_native, to_native
from viskill_deploy.drivers.crtk.ros1_types import NAMES, ros1_class, service_class
from viskill_deploy.drivers.crtk.transport import EVENTS_KEPT, M, Q, R, TransportName, hand_over


class Ros1:
    """One user of this process's node; it is a `Transport`.

    Args:
        node: what the node is called; a number follows, since ROS 1 ends the older of two nodes
            of one name.
        interface: address of this machine that others are told; 127.0.0.1 also listens nowhere
            else. "" leaves it to ROS_IP and ROS_HOSTNAME.

    Raises:
        DriverError: no master answers.
    """

    name: TransportName = "ros1"
    has_services = True

    def __init__(self, node: str = "viskill", interface: str = "") -> None:
        _join(node, interface)
        self._clock, self._is_open = MonotonicClock(), True
        self._turn = threading.Lock()
        self._mouths: dict[str, Any] = {}
        self._ears: dict[str, Any] = {}
        self._kinds: dict[str, type[Any]] = {}
        self._ends: list[Callable[[], object]] = []

    def publisher(
        self, topic: str, message: type[M], is_latched: bool = False
    ) -> Callable[[M], None]:
        """What publishes on a topic; other threads send, and the newest displaces the oldest."""
        self._check(topic, message)
        mouth = rospy.Publisher(
            topic,
            ros1_class(message),
            latch=is_latched,
            tcp_nodelay=True,
            queue_size=_kept(is_latched),
        )
        self._mouths[topic] = mouth
        self._ends.append(mouth.unregister)
        convert = to_native(message, ros1_class, NAMES)

        def publish(word: M) -> None:
            if type(word) is not message or not self._is_open:
                self._check(topic, type(word))
            try:
                mouth.publish(convert(word))
            except (rospy.ROSException, rospy.ROSSerializationException) as error:
                raise DriverError(f"{topic} was not sent; is ROS up? {error}") from error

        return publish

    def subscribe(
        self,
        topic: str,
        message: type[M],
        hear: Callable[[M, float], None],
        is_latched: bool = False,
        kept: int = 1,
    ) -> None:
        """Calls `hear` for all that comes, never two at a time."""
        self._check(topic, message)
        convert = from_native(message, NAMES)

        def arrive(sample: Any) -> None:
            now = self._clock.now()
            with self._turn:
                if self._is_open:
                    hand_over(topic, sample, convert, hear, now)

        ear = rospy.Subscriber(
            topic, ros1_class(message), arrive, tcp_nodelay=True, queue_size=_kept(is_latched, kept)
        )
        self._ears[topic] = ear
        self._ends.append(ear.unregister)

    def serve(
        self, name: str, request: type[Q], response: type[R], answer: Callable[[Q], R]
    ) -> None:
        """Answers a service, in a thread of the one who asks."""
        if not self._is_open:
            raise DriverError(f"{name}: this node is closed")
        kind = service_class(request, response)
        ask = from_native(request, NAMES)

        def native(part: type[Any]) -> Any:
            return kind._response_class if part is response else ros1_class(part)

        tell = to_native(response, native, NAMES)
        service = rospy.Service(name, kind, lambda question: tell(answer(ask(question))))
        self._ends.append(service.shutdown)

    def peers(self, topic: str) -> int:
        """How many others are on the topic, on the side that we are not on."""
        if not self._is_open:
            return 0
        if topic in self._mouths:
            return int(self._mouths[topic].get_num_connections()) - (topic in self._ears)
        return int(self._ears[topic].get_num_connections()) if topic in self._ears else 0

    def stamp_ns(self) -> int:
        """The machine's time of day."""
        return wall_ns()

    def close(self) -> None:
        """Takes back what was opened here; the process's node goes with the process."""
        with self._turn:
            self._is_open = False
        while self._ends:
            self._ends.pop()()

    def _check(self, topic: str, message: type[Any]) -> None:
        if not self._is_open:
            raise DriverError(f"{topic}: this node is closed")
        carried = self._kinds.setdefault(topic, message)
        if carried is not message:
            raise DriverError(f"{topic} carries {carried.__name__}, not {message.__name__}")


def _kept(is_latched: bool, kept: int = 1) -> int:
    """As dVRK's bridge has it: the newest only, but for events all that fits."""
    return EVENTS_KEPT if is_latched else kept


def _join(node: str, interface: str) -> None:
    """Makes this process a node, if it is none.

    rospy waits for a master for ever, so one is looked for first.
    """
    if rospy.core.is_initialized():
        return
    if interface:
        os.environ["ROS_IP"] = os.environ["ROS_HOSTNAME"] = interface
    try:
        rosgraph.Master("/viskill").getPid()
    except (OSError, rosgraph.MasterException, ValueError) as error:
        where = os.environ.get("ROS_MASTER_URI", "http://localhost:11311")
        raise DriverError(
            f"no ROS 1 master answers at {where}; start roscore or set ROS_MASTER_URI"
        ) from error
    rospy.init_node(node, argv=[], anonymous=True, disable_signals=True)
