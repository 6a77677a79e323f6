"""dVRK arms that are listened to and never spoken to: a person moves them, we look on."""

from __future__ import annotations

from collections.abc import Callable
from typing import NoReturn

from viskill_deploy.core.clock import Clock
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.crtk.driver import CrtkDriver, CrtkOptions
from viskill_deploy.drivers.crtk.opening import Network, open_transport
from viskill_deploy.drivers.crtk.transport import M, Q, R, Transport, TransportName
from viskill_deploy.drivers.watch import OwnTime

PERIOD_S = 0.01
"""A dVRK publishes its joints so often."""


class Ears:
    """A node that hears all and says nothing: it is a `Transport` that publishes nowhere.

    Args:
        node: the node that hears; closed with this one.
    """

    name: TransportName
    has_services = False

    def __init__(self, node: Transport) -> None:
        self._node, self.name = node, node.name

    def publisher(
        self, topic: str, message: type[M], is_latched: bool = False
    ) -> Callable[[M], None]:
        """What refuses to publish; nobody on the network learns of it."""
        del message, is_latched

        def refuse(word: M) -> NoReturn:
            raise DriverError(f"{topic}: {word!r} was not sent: arms are only listened to here")

        return refuse

    def subscribe(
        self,
        topic: str,
        message: type[M],
        hear: Callable[[M, float], None],
        is_latched: bool = False,
        kept: int = 1,
    ) -> None:
        """Hears a topic."""
        self._node.subscribe(topic, message, hear, is_latched, kept)

    def serve(
        self, name: str, request: type[Q], response: type[R], answer: Callable[[Q], R]
    ) -> None:
        """Nothing is asked of who only listens."""
        raise DriverError(f"{name}: no service is offered by who only listens")

    def peers(self, topic: str) -> int:
        """How many are at the other end."""
        return self._node.peers(topic)

    def stamp_ns(self) -> int:
        """Now, as messages are stamped."""
        return self._node.stamp_ns()

    def close(self) -> None:
        """Closes the node."""
        self._node.close()


def listening(cell: CellDescription, node: Transport, clock: Clock | None = None) -> CrtkDriver:
    """A connected driver whose arms cannot be told anything: no watchdog stands by, none is needed.

    Args:
        cell: the arms.
        node: a node on their network; closed with the driver.
        clock: that of the arms, where it is simulated.

    Raises:
        DriverError: an arm is not heard, or is not the cell's.
    """
    driver = CrtkDriver(cell, Ears(node), CrtkOptions(period_s=PERIOD_S), OwnTime)
    driver.clock = clock or driver.clock
    driver.connect()
    return driver


def listen(cell: CellDescription, transport: str, network: Network) -> CrtkDriver:
    """The same, on the robot's network.

    Args:
        cell: the arms.
        transport: "ros1", "ros2", "dds" or "auto".
        network: where they are.

    Raises:
        DriverError: an arm is not heard, or is not the cell's.
        MissingExtraError: the transport's middleware is not installed.
    """
    return listening(cell, open_transport(transport, network))
