"""A CRTK client as dVRK's Python client is one, by rospy or rclpy alone: none of our transports.

As a program it is a second client of the same arm: it moves the first joint and tells where it is.
"""

import importlib
import json
import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import pytest

from viskill_deploy.drivers.crtk import messages
from viskill_deploy.drivers.crtk.interfaces import ros2_environment
from viskill_deploy.drivers.crtk.opening import LOOPBACK

EACH_ROS = pytest.mark.parametrize(
    "ros",
    [pytest.param("ros1", marks=pytest.mark.ros1), pytest.param("ros2", marks=pytest.mark.ros2)],
)
"""For tests of both; ROS 1 needs the fixture `ros_network`, too."""

PATIENCE_S = 30.0
NANO = 1_000_000_000

HEARD = {
    "operating_state": messages.OperatingState,
    **dict.fromkeys(
        ("measured_js", "setpoint_js", "jaw/measured_js", "jaw/setpoint_js"), messages.JointState
    ),
    **dict.fromkeys(
        ("measured_cp", "setpoint_cp", "local/measured_cp", "local/setpoint_cp"),
        messages.PoseStamped,
    ),
    "measured_cv": messages.TwistStamped,
    **dict.fromkeys(("body/measured_cf", "spatial/measured_cf"), messages.WrenchStamped),
    **dict.fromkeys(("body/jacobian", "spatial/jacobian"), messages.Float64MultiArray),
    "trajectory_j/ratio": messages.Float,
}
"""What dVRK's client listens to, by its `check_connections`; not taken from our table of topics."""

SAID = {
    "state_command": messages.StringStamped,
    **dict.fromkeys(("hold", "free"), messages.Empty),
    **dict.fromkeys(
        (
            *("servo_jp", "servo_jr", "servo_jf", "move_jp", "move_jr"),
            *("jaw/servo_jp", "jaw/servo_jf", "jaw/move_jp"),
        ),
        messages.JointState,
    ),
    **dict.fromkeys(("servo_cp", "move_cp"), messages.PoseStamped),
    **dict.fromkeys(("body/servo_cf", "spatial/servo_cf"), messages.WrenchStamped),
    **dict.fromkeys(
        ("body/set_cf_orientation_absolute", "use_gravity_compensation", "emulate_tool_present"),
        messages.Bool,
    ),
    "trajectory_j/set_ratio": messages.Float,
}
"""What it says."""

LATCHED = ("operating_state", "trajectory_j/ratio", "error", "warning")


class Rospy:
    """ROS 1."""

    def __init__(self, domain: int) -> None:
        import rospy  # noqa: PLC0415 - only where ROS 1 is

        del domain
        self._rospy, self._made = rospy, list[Any]()
        if not rospy.core.is_initialized():  # a process is one node, whoever made it
            rospy.init_node("dvrk_client", anonymous=True, disable_signals=True)

    def kind(self, message: type[Any]) -> Any:
        from viskill_deploy.drivers.crtk.ros1_types import ros1_class  # noqa: PLC0415

        return ros1_class(message)

    def hear(self, name: str, kind: Any, call: Callable[[Any], Any]) -> Callable[[], int]:
        self._made.append(self._rospy.Subscriber(name, kind, call))
        return self._made[-1].get_num_connections

    def say(self, name: str, kind: Any, latch: bool) -> tuple[Any, Callable[[], int]]:
        made = self._rospy.Publisher(name, kind, latch=latch, queue_size=1)
        self._made.append(made)
        return made.publish, made.get_num_connections

    def ask(self, name: str, request: type[Any], response: type[Any]) -> Callable[..., Any]:
        from viskill_deploy.drivers.crtk.ros1_types import service_class  # noqa: PLC0415

        self._rospy.wait_for_service(name, PATIENCE_S)
        return self._rospy.ServiceProxy(name, service_class(request, response))

    def stamp(self, header: Any, ns: int) -> None:
        header.stamp.secs, header.stamp.nsecs = divmod(ns, NANO)

    def ns(self, header: Any) -> int:
        return header.stamp.secs * NANO + header.stamp.nsecs

    def close(self) -> None:
        """A process stays a node; nobody hears or latches anything any more."""
        for made in self._made:
            made.unregister()


class Rclpy:
    """ROS 2."""

    def __init__(self, domain: int) -> None:
        import rclpy  # noqa: PLC0415 - only where ROS 2 is
        from rclpy.executors import SingleThreadedExecutor  # noqa: PLC0415

        self._rclpy, self._context = rclpy, rclpy.Context()
        with ros2_environment(LOOPBACK):
            rclpy.init(args=[], context=self._context, domain_id=domain)
            self._node = rclpy.create_node("dvrk_client", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def kind(self, message: type[Any]) -> Any:
        package, name = message.ROS.split("/")
        return getattr(importlib.import_module(f"{package}.msg"), name)

    def hear(self, name: str, kind: Any, call: Callable[[Any], Any]) -> Callable[[], int]:
        self._node.create_subscription(kind, name, call, self._qos(False))
        return lambda: self._node.count_publishers(name)

    def say(self, name: str, kind: Any, latch: bool) -> tuple[Any, Callable[[], int]]:
        made = self._node.create_publisher(kind, name, self._qos(latch))
        return made.publish, made.get_subscription_count

    def ask(self, name: str, request: type[Any], response: type[Any]) -> Callable[..., Any]:
        del response
        package, kind = request.ROS.split("/")
        service = getattr(importlib.import_module(f"{package}.srv"), kind)
        client = self._node.create_client(service, name)
        assert client.wait_for_service(PATIENCE_S)

        def call(**fields: Any) -> Any:
            future = client.call_async(service.Request(**fields))
            deadline = time.monotonic() + PATIENCE_S
            while not future.done():
                assert time.monotonic() < deadline, name
                time.sleep(0.005)
            return future.result()

        return call

    def stamp(self, header: Any, ns: int) -> None:
        header.stamp.sec, header.stamp.nanosec = divmod(ns, NANO)

    def ns(self, header: Any) -> int:
        return header.stamp.sec * NANO + header.stamp.nanosec

    def close(self) -> None:
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()
        self._rclpy.shutdown(context=self._context)

    def _qos(self, latch: bool) -> Any:
        from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: PLC0415

        lasting = DurabilityPolicy.TRANSIENT_LOCAL if latch else DurabilityPolicy.VOLATILE
        return QoSProfile(depth=1, durability=lasting)


MIDDLEWARE = {"ros1": Rospy, "ros2": Rclpy}


class NativeClient:
    """A client of one arm.

    Attributes:
        heard: all that came, by topic.
        ros: the middleware.
    """

    def __init__(self, name: str, domain: int, arm: str = "PSM1") -> None:
        self.ros, self._arm = MIDDLEWARE[name](domain), arm
        self.heard: dict[str, list[Any]] = {}
        self._say: dict[str, Any] = {}
        self._peers: dict[str, Callable[[], int]] = {}
        for topic, message in {
            **HEARD,
            **dict.fromkeys(("error", "warning"), messages.String),
        }.items():
            words = self.heard.setdefault(topic, [])
            self._peers[topic] = self.ros.hear(
                f"/{arm}/{topic}", self.ros.kind(message), words.append
            )
        for topic, message in SAID.items():
            self._say[topic], self._peers[topic] = self.ros.say(
                f"/{arm}/{topic}", self.ros.kind(message), topic == "state_command"
            )

    @property
    def state(self) -> tuple[str, bool, bool]:
        """Operating state, homed, busy."""
        states = self.heard["operating_state"]
        return (states[-1].state, states[-1].is_homed, states[-1].is_busy) if states else ("",) * 3

    def missing(self) -> list[str]:
        """Endpoints with nobody at the other end."""
        return [topic for topic in (*HEARD, *SAID) if not self._peers[topic]()]

    def wait(self, what: str, is_so: Callable[[], Any]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not is_so():
            told = [m.data for m in self.heard["error"][-3:] + self.heard["warning"][-3:]]
            assert time.monotonic() < deadline, f"{what}; {self.state}, {told}, {self.missing()}"
            time.sleep(0.005)

    def say(self, topic: str, **fields: Any) -> None:
        """Publishes a message."""
        word = self.ros.kind(SAID[topic])(**fields)
        if hasattr(word, "header"):
            self.ros.stamp(word.header, time.time_ns())
        self._say[topic](word)

    def command(self, word: str, is_stamped: bool = True) -> None:
        """A state command, latched; dVRK's client does not stamp it."""
        if is_stamped:
            self.say("state_command", string=word)
        else:
            self._say["state_command"](self.ros.kind(messages.StringStamped)(string=word))

    def joints(self, topic: str) -> tuple[float, ...]:
        """The newest positions of a topic."""
        return tuple(self.heard[topic][-1].position)

    def wait_for(self, topic: str, goal: Sequence[float]) -> None:
        """Until joints are said to be at a goal: topics overtake each other over ROS 1."""
        self.wait(
            f"{topic} is not {goal}",
            lambda: max(abs(a - b) for a, b in zip(self.joints(topic), goal, strict=True)) < 1e-9,
        )

    def moves(self, topic: str, **fields: Any) -> None:
        """Sends a motion and waits as dVRK's client does: busy after the request, then not."""
        began = time.time_ns()
        self.say(topic, **fields)
        self.wait(f"{topic} does not begin", lambda: self._since(began, True))
        self.wait(f"{topic} does not end", lambda: self._since(began, True) and not self.state[2])

    def close(self) -> None:
        self.ros.close()

    def _since(self, began_ns: int, is_busy: bool) -> bool:
        states = tuple(self.heard["operating_state"])
        return any(self.ros.ns(s.header) > began_ns and s.is_busy == is_busy for s in states)


def main() -> None:
    """Moves the first joint of PSM1 and tells what it has heard."""
    name, domain, yaw = sys.argv[1:]
    client = NativeClient(name, int(domain))
    client.wait("not all endpoints", lambda: not client.missing())
    client.wait("not ready", lambda: client.state == ("ENABLED", True, False))
    client.wait("no setpoint", lambda: client.heard["setpoint_js"])
    goal = [float(yaw), *client.joints("setpoint_js")[1:]]
    client.moves("move_jp", position=goal)
    client.wait_for("setpoint_js", goal)
    print(json.dumps({"state": client.state, "held": client.joints("setpoint_js")}), flush=True)
    client.close()


if __name__ == "__main__":
    main()
