"""CRTK over ROS 2 (rclpy): seen by all of ROS's tools, and with services.

Messages go as bytes that `cdr` makes and reads, which costs less than rclpy's own conversion.
"""

from __future__ import annotations

import contextlib
import importlib
import threading
from collections.abc import Callable
from typing import Any

import crtk_msgs.msg  # noqa: F401 - looked for before the robot is
import rclpy
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from viskill_deploy.core.clock import MonotonicClock, wall_ns
from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.crtk.cdr import decoder, encoder
from viskill_deploy.drivers.crtk.conversion import from_native, to_native
from viskill_deploy.drivers.crtk.interfaces import is_loopback, ros2_environment
from viskill_deploy.drivers.crtk.loopback_only import confine
from viskill_deploy.drivers.crtk.ros2_ears import Ears
from viskill_deploy.drivers.crtk.transport import EVENTS_KEPT, M, Q, R, TransportName, hand_over

NO_EVENTS = (
    SubscriptionEventCallbacks(use_default_callbacks=False),
    PublisherEventCallbacks(use_default_callbacks=False),
)
"""rclpy would wait for several events of every topic: with two arms, four times slower."""


class Ros2:
    """One node; it is a `Transport`.

    Args:
        node: what the node is called.
        domain: ROS_DOMAIN_ID of the robot.
        interface: address of this machine to speak on, 127.0.0.1 to stay on it; "" leaves the
            choice to ROS and its settings.

    Raises:
        DriverError: ROS 2 does not start.
    """

    name: TransportName = "ros2"
    has_services = True

    def __init__(self, node: str = "viskill", domain: int = 0, interface: str = "") -> None:
        self._clock, self._is_open = MonotonicClock(), True
        self._mouths: dict[str, Any] = {}
        self._ears: dict[str, list[Any]] = {}
        self._kinds: dict[str, type[Any]] = {}
        self._context = rclpy.Context()
        try:
            self._node = self._join(node, domain, interface)
        except (RuntimeError, DriverError) as error:
            self._context.try_shutdown()
            where = interface or "any interface"
            raise DriverError(
                f"ROS 2 does not start in domain {domain} on {where}: {error}"
            ) from error
        self._listener = Ears(self._context)
        self._executor: SingleThreadedExecutor | None = None  # of services, where there are any

    def _join(self, node: str, domain: int, interface: str) -> Any:
        with ros2_environment(interface):
            rclpy.init(args=[], context=self._context, domain_id=domain)
            made = rclpy.create_node(
                node, context=self._context, enable_rosout=False, start_parameter_services=False
            )
        if is_loopback(interface):
            confine(domain)
        return made

    def publisher(
        self, topic: str, message: type[M], is_latched: bool = False
    ) -> Callable[[M], None]:
        """What publishes on a topic."""
        self._check(topic, message)
        mouth = self._node.create_publisher(
            _class(message), topic, _qos(is_latched), event_callbacks=NO_EVENTS[1]
        )
        self._mouths[topic] = mouth
        encode = encoder(message)

        def publish(word: M) -> None:
            if type(word) is not message or not self._is_open:
                self._check(topic, type(word))
            try:
                mouth.publish(encode(word))
            except RuntimeError as error:
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
        """Calls `hear` from this node's thread for all that comes."""
        self._check(topic, message)
        decode = decoder(message)

        def arrive(data: bytes) -> None:
            hand_over(topic, data, decode, hear, self._clock.now())

        kind = _class(message)
        ear = self._node.create_subscription(
            kind, topic, arrive, _qos(is_latched, kept), raw=True, event_callbacks=NO_EVENTS[0]
        )
        self._ears.setdefault(topic, []).append(ear)
        self._listener.add(ear, kind, arrive)

    def serve(
        self, name: str, request: type[Q], response: type[R], answer: Callable[[Q], R]
    ) -> None:
        """Answers a service from a thread of its own."""
        if not self._is_open:
            raise DriverError(f"{name}: this node is closed")
        kind = _class(request, "srv")

        def native(part: type[Any]) -> Any:
            return kind.Response if part is response else _class(part)

        ask, tell = from_native(request), to_native(response, native)
        self._services().create_service(kind, name, lambda asked, _: tell(answer(ask(asked))))

    def peers(self, topic: str) -> int:
        """How many others are on the topic, on the side that we are not on."""
        if not self._is_open:
            return 0
        ears = len(self._ears.get(topic, ()))
        if topic in self._mouths:
            return int(self._mouths[topic].get_subscription_count()) - ears
        return int(self._node.count_publishers(topic)) if ears else 0

    def stamp_ns(self) -> int:
        """The machine's time of day."""
        return wall_ns()

    def close(self) -> None:
        """Leaves ROS."""
        if not self._is_open:
            return
        self._is_open = False
        self._listener.close()
        if self._executor is not None:
            self._executor.shutdown()
            if threading.current_thread() is not self._thread:
                self._thread.join()
            self._clerk.destroy_node()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def _check(self, topic: str, message: type[Any]) -> None:
        if not self._is_open:
            raise DriverError(f"{topic}: this node is closed")
        carried = self._kinds.setdefault(topic, message)
        if carried is not message:
            raise DriverError(f"{topic} carries {carried.__name__}, not {message.__name__}")

    def _services(self) -> Any:
        """The node that answers services, so that topics need no executor."""
        if self._executor is None:
            self._clerk = rclpy.create_node(
                f"{self._node.get_name()}_services",
                context=self._context,
                enable_rosout=False,
                start_parameter_services=False,
            )
            self._executor = SingleThreadedExecutor(context=self._context)
            self._executor.add_node(self._clerk)
            self._thread = threading.Thread(target=self._spin, name="crtk-services", daemon=True)
            self._thread.start()
        return self._clerk

    def _spin(self) -> None:
        with contextlib.suppress(ExternalShutdownException):
            if self._executor is not None:
                self._executor.spin()


def _class(message: type[Any], folder: str = "msg") -> Any:
    """The installed class of one of `messages`."""
    package, name = message.ROS.split("/")
    return getattr(importlib.import_module(f"{package}.{folder}"), name)


def _qos(is_latched: bool, kept: int = 1) -> Any:
    """As dVRK's bridge has it: RELIABLE, the newest only, but for events all that fits."""
    lasting = DurabilityPolicy.TRANSIENT_LOCAL if is_latched else DurabilityPolicy.VOLATILE
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=EVENTS_KEPT if is_latched else kept,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=lasting,
    )
