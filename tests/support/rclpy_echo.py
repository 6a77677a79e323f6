"""An echo by rclpy and its own conversion alone, to hold our transports against."""

import importlib
import threading
from collections.abc import Callable
from typing import Any

import crtk_samples

from viskill_deploy.drivers.crtk.interfaces import ros2_environment
from viskill_deploy.drivers.crtk.opening import LOOPBACK


def start(domain: int) -> Callable[[], None]:
    """Echoes /there/… on /back/…, until the function returned is called."""
    import rclpy  # noqa: PLC0415 - only where ROS 2 is
    from rclpy.executors import SingleThreadedExecutor  # noqa: PLC0415

    context = rclpy.Context()
    with ros2_environment(LOOPBACK):
        rclpy.init(args=[], context=context, domain_id=domain)
        node = rclpy.create_node("echo", context=context)
    for topic in crtk_samples.TOPICS:
        package, name = topic.message.ROS.split("/")
        kind = getattr(importlib.import_module(f"{package}.msg"), name)
        _echo(node, kind, topic.name)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    thread = threading.Thread(target=executor.spin, daemon=True)
    thread.start()

    def close() -> None:
        executor.shutdown()
        thread.join()
        node.destroy_node()
        rclpy.shutdown(context=context)

    return close


def _echo(node: Any, kind: Any, name: str) -> None:
    back = node.create_publisher(kind, f"/back/{name}", 1)
    node.create_subscription(kind, f"/there/{name}", back.publish, 1)
