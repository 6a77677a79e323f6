"""Opens the way to dVRK arms, with a watchdog beside it."""

from __future__ import annotations

from functools import partial

from viskill_deploy.core.description import CellDescription
from viskill_deploy.drivers.crtk.driver import CrtkDriver, CrtkOptions
from viskill_deploy.drivers.crtk.opening import Network, open_transport
from viskill_deploy.drivers.crtk.watchdog import start_watch


def connect(
    cell: CellDescription,
    transport: str,
    network: Network | None = None,
    options: CrtkOptions | None = None,
) -> CrtkDriver:
    """A connected driver; nothing has been sent to the arms.

    Args:
        cell: the arms.
        transport: "ros1", "ros2", "dds" or "auto".
        network: where they are.
        options: period and console.

    Raises:
        DriverError: an arm is not heard, or is not the cell's.
        MissingExtraError: the transport's middleware is not installed.
    """
    network = network or Network()
    node = open_transport(transport, network)
    names = [arm.name for arm in cell.arms]
    start = partial(start_watch, names, node.name, network)
    driver = CrtkDriver(cell, node, options or CrtkOptions(), start)
    driver.connect()
    return driver
