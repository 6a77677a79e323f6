"""The robots that a bundle is executed on, by driver. Each is imported when it is chosen."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from viskill_deploy.core.description import CellDescription
from viskill_deploy.drivers.base import Driver
from viskill_deploy.runtime.driving import simulated_driver, with_inputs
from viskill_deploy.sim.world import WorldOptions

RobotName = Literal["loopback", "can"]


@dataclass(frozen=True)
class RobotOptions:
    """Which robot, and the way to it.

    Attributes:
        name: what it is reached by; "loopback" is the simulated cell.
        real_time: the simulated cell runs as a process of its own, against the clock.
        can: name of the CAN file; "" for the cell's.
        seed: of the simulated cell.
        inputs: node whose consent and emergency stop count, such as "can:pedal".
    """

    name: RobotName = "loopback"
    real_time: bool = False
    can: str = ""
    seed: int = 0
    inputs: str = ""


def connected(cell: CellDescription, options: RobotOptions) -> Driver:
    """A connected driver, with the inputs that were asked for; nothing was sent to the arms.

    Raises:
        DriverError: it cannot be connected.
        DataFileError: a file of it is wrong.
        MissingExtraError: it needs a package that is not installed.
    """
    return with_inputs(_connected(cell, options), options.inputs)


def _connected(cell: CellDescription, options: RobotOptions) -> Driver:
    if options.name == "can":
        from viskill_deploy.drivers.can import driver as can  # noqa: PLC0415 - optional
        from viskill_deploy.drivers.can.config import load_can  # noqa: PLC0415 - optional

        return can.connect(cell, load_can(options.can or cell.name, cell))
    return simulated_driver("loopback", cell, WorldOptions(), options.seed, options.real_time)
