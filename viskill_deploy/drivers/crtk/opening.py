"""Opens the transport that a robot speaks, and finds out which that is.

The middleware is imported only here and only when it is asked for: no two fit into one environment
everywhere.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from dataclasses import dataclass

from viskill_deploy.core import realtime
from viskill_deploy.core.errors import DriverError, MissingExtraError, MissingRosError
from viskill_deploy.drivers.crtk.interfaces import demand_own
from viskill_deploy.drivers.crtk.readiness import ADVICE, choose
from viskill_deploy.drivers.crtk.transport import Transport

LOG = logging.getLogger(__name__)

LOOPBACK = "127.0.0.1"
"""The interface of who must not be reached from outside: simulators and tests."""


@dataclass(frozen=True, slots=True)
class Network:
    """Where the robot is.

    Attributes:
        domain: ROS 2 domain; None takes ROS_DOMAIN_ID, or 0.
        interface: address of this machine to speak on, `LOOPBACK` to stay on it; "" leaves it to
            the middleware, which finds the robot's network by itself.
        node: what this node is called; a number follows where names must differ.
    """

    domain: int | None = None
    interface: str = ""
    node: str = "viskill"

    def domain_id(self) -> int:
        """The domain, or what the environment says.

        Raises:
            DriverError: ROS_DOMAIN_ID is no domain.
        """
        said = os.environ.get("ROS_DOMAIN_ID") or "0" if self.domain is None else str(self.domain)
        if not said.isascii() or not said.isdigit() or int(said) > LAST_DOMAIN:
            raise DriverError(f"ROS domain {said!r} is none of 0 to {LAST_DOMAIN}; correct it")
        return int(said)


Open = Callable[[Network], Transport]

LAST_DOMAIN = 232
"""The last whose ports exist."""


def open_transport(name: str, network: Network | None = None) -> Transport:
    """A node on the robot's network.

    Args:
        name: "ros1", "ros2" or "dds"; "auto" takes what `readiness.choose` says. The transport's
            own `name` says which it became.
        network: where.

    Raises:
        DriverError: there is no such transport, or the network does not open.
        MissingExtraError: CycloneDDS is not installed.
        MissingRosError: ROS is not.
    """
    if name == "auto":
        choice = choose()
        LOG.info("CRTK over %s: %s", choice.name, choice.reason)
        name = choice.name
    if name not in MIDDLEWARE:
        raise DriverError(f"there is no transport {name!r}; say auto, {', '.join(MIDDLEWARE)}")
    network = network or Network()
    demand_own(network.interface)
    open_ = MIDDLEWARE[name]()
    with realtime.ahead():  # its threads bring what the control loop waits for
        return open_(network)


def _dds() -> Open:
    try:
        from viskill_deploy.drivers.crtk.dds import Dds  # noqa: PLC0415 - optional
    except ImportError as error:
        raise MissingExtraError("ros", "CRTK over plain DDS") from error
    return lambda network: Dds(network.domain_id(), network.interface)


def _ros1() -> Open:
    try:
        from viskill_deploy.drivers.crtk.ros1 import Ros1  # noqa: PLC0415 - optional
    except ImportError as error:
        raise MissingRosError(f"rospy cannot be imported ({error}); {ADVICE['ros1']}") from error
    return lambda network: Ros1(network.node, network.interface)


def _ros2() -> Open:
    try:
        from viskill_deploy.drivers.crtk.ros2 import Ros2  # noqa: PLC0415 - optional
    except ImportError as error:
        raise MissingRosError(
            f"rclpy or crtk_msgs cannot be imported ({error}); {ADVICE['ros2']}"
        ) from error
    return lambda network: Ros2(network.node, network.domain_id(), network.interface)


MIDDLEWARE: dict[str, Callable[[], Open]] = {"ros1": _ros1, "ros2": _ros2, "dds": _dds}
