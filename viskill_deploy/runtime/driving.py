"""The drivers of simulated cells, by name. Each is imported when it is chosen: some need extras."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DriverError, ViskillError
from viskill_deploy.drivers import loopback, loopback_served
from viskill_deploy.drivers.base import Driver
from viskill_deploy.sim.world import WorldOptions

DriverName = Literal["loopback", "can", "crtk"]


def simulated_driver(
    name: DriverName,
    cell: CellDescription,
    world: WorldOptions,
    seed: int,
    real_time: bool,
    transport: str = "dds",
) -> Driver:
    """A connected driver of a simulated cell.

    Args:
        name: what stands between runtime and cell: nothing, CiA 402 drives on CAN, or dVRK arms.
        cell: the cell as the runtime believes it to be.
        world: control period, noise and delay.
        seed: of noise, offsets and losses.
        real_time: the cell runs as a process of its own, against the clock; else it is stepped.
        transport: what carries CRTK between two processes.

    Raises:
        DriverError: it cannot be connected.
        MissingExtraError: it needs a package that is not installed.
    """
    connect: Callable[[CellDescription, WorldOptions, int], Driver]
    match name:
        case "can":
            from viskill_deploy.drivers.can import simulated as can  # noqa: PLC0415

            connect = can.connect_served if real_time else can.connect
        case "crtk":
            from viskill_deploy.drivers.crtk import simulated as crtk  # noqa: PLC0415

            served = partial(crtk.connect_served, transport=transport)
            connect = served if real_time else crtk.connect
        case "loopback":
            connect = loopback_served.connect if real_time else loopback.connect
    return connect(cell, world, seed)


def with_inputs(driver: Driver, inputs: str) -> Driver:
    """The same arms, moved only while a node of its own agrees.

    Args:
        driver: connected; closed when the node is not there.
        inputs: such as "can:pedal" or "can:mine.toml"; "" leaves the driver as it is.

    Raises:
        DriverError: there is no such kind of input, or the node says nothing.
        MissingExtraError: it needs a package that is not installed.
    """
    kind, _, name = inputs.partition(":")
    if not inputs:
        return driver
    try:
        if kind != "can" or not name:
            raise DriverError(f"inputs {inputs!r} are unknown; write can:FILE")
        from viskill_deploy.drivers.can.with_inputs import (  # noqa: PLC0415
            WithInputNode,
            load_inputs,
        )

        return WithInputNode(driver, load_inputs(name))
    except ViskillError:
        driver.close()
        raise
