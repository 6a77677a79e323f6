"""The CAN driver on simulated drives: stepped on a virtual bus, or against a process of its own."""

from __future__ import annotations

import ipaddress
import itertools
import os

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import FloatArray, JointSetpoint, Scene
from viskill_deploy.drivers.base import Capabilities, Driver
from viskill_deploy.drivers.can.config import CanFile, load_can
from viskill_deploy.drivers.can.driver import CanDriver
from viskill_deploy.drivers.can.simulated_cell import DriveCell
from viskill_deploy.drivers.loopback import WorldClock
from viskill_deploy.drivers.loopback_cell import LoopbackCell
from viskill_deploy.drivers.loopback_served import ServedLoopback
from viskill_deploy.drivers.sides import SIMULATED, Side, SteppedSide, WithSide
from viskill_deploy.sim.world import World, WorldOptions

SERVER = "viskill_deploy.drivers.can.server"

FIRST_GROUP, GROUPS = ipaddress.IPv4Address("239.64.0.0"), 2**20
MOST_BUSES = 16
"""Buses of one process before its groups reach those of the next."""

_numbers = itertools.count()


class SimulatedCan(WithSide, CanDriver):
    """The CAN driver of a simulated cell; everything but `side` goes over the buses."""

    def __init__(
        self, cell: CellDescription, file: CanFile, side: Side, period_s: float | None = None
    ) -> None:
        super().__init__(cell, file, SIMULATED, period_s)
        self.side = side

    def reset(self, layout: Scene) -> None:
        """Puts objects where `layout` says and the arms, without power meanwhile, at home."""
        was_enabled = self._is_enabled
        self.disable()
        with self._lock:
            self.side.reset(layout)
            self._restart()
            for _ in range(RESTART_PERIODS):
                self._pass_period()
            self._restart()
            self._measured.forget()
        if was_enabled:
            self.enable()

    def close(self) -> None:
        """Takes power, closes the buses and ends the simulation."""
        super().close()
        self.side.close()


RESTART_PERIODS = 10
"""Cycles in which drives and input node are heard again after the simulation stood still."""


class SteppedCan(SimulatedCan):
    """Drives on `virtual` buses in this process; time moves only when the clock is slept on.

    Args:
        cell: the cell as the runtime believes it to be.
        file: the drives as the driver believes them to be wired.
        options: period, noise, delay and what else is not perfect.
        seed: of noise, offsets and losses.
        really: the cell as it is; `cell` when left out.
        wiring: the drives as they are wired; as in `file` when left out.
    """

    capabilities = Capabilities(simulated=True, stepped=True, resettable=True, sees_scene=True)

    def __init__(
        self,
        cell: CellDescription,
        file: CanFile,
        options: WorldOptions | None = None,
        seed: int = 0,
        really: CellDescription | None = None,
        wiring: CanFile | None = None,
    ) -> None:
        number = next(_numbers)
        self.world = World(really or cell.filed or cell, options, seed)
        self._time = WorldClock(self)
        file, wiring = _private(file, number), _private(wiring or file, number)
        self.front = DriveCell(LoopbackCell(self.world), wiring)
        side = SteppedSide(self.front.cell, self._time, self.front.close)
        super().__init__(cell, file, side, self.world.options.period_s)
        self.clock = self._time
        self._seen = 0

    def pause(self) -> None:
        """Lets the drives answer; no time passes."""
        self.front.poll(self._time.world_s)

    def advance(self) -> None:
        """One control period; drives get their SYNC in it, also when nobody sends a setpoint."""
        if self.masters and self.exchanges == self._seen:
            self.keep()
        self._seen = self.exchanges
        self.front.advance(self._time.world_s)

    def lateness_s(self) -> float:
        """How late the control loop wakes this time."""
        return self.world.imperfections.lateness_s()

    def restore(self, physics: FloatArray, setpoints: list[JointSetpoint]) -> None:
        """Goes to a saved moment of the scene that `reset` has set up, at rest."""
        self.front.cell.restore(physics, setpoints)


def _private(file: CanFile, number: int) -> CanFile:
    """The same file on virtual buses that nobody else in this process uses."""
    channels = [f"{os.getpid()}-{number}-{bus.arm}" for bus in file.bus]
    return _on(file, "virtual", channels)


def on_own_groups(file: CanFile) -> CanFile:
    """The same file on multicast groups that hardly any other process uses.

    One that does is another master, which stops both.
    """
    first = os.getpid() * MOST_BUSES + next(_numbers) * len(file.bus)
    groups = [str(FIRST_GROUP + (first + i) % GROUPS) for i in range(len(file.bus))]
    return _on(file, "udp_multicast", groups)


def _on(file: CanFile, interface: str, channels: list[str]) -> CanFile:
    pairs = zip(file.bus, channels, strict=True)
    buses = tuple(bus.model_copy(update={"channel": channel}) for bus, channel in pairs)
    return file.model_copy(update={"interface": interface, "bus": buses})


class ServedCan(SimulatedCan):
    """Drives in a process of their own, in real time; buses by the file's interface.

    Args:
        cell: the cell.
        file: its drives.
        options: period, noise, delay and what else is not perfect.
        seed: of noise, offsets and losses.
    """

    capabilities = Capabilities(simulated=True, stepped=False, resettable=True, sees_scene=True)

    def __init__(
        self,
        cell: CellDescription,
        file: CanFile,
        options: WorldOptions | None = None,
        seed: int = 0,
    ) -> None:
        options = options or WorldOptions(period_s=1.0 / file.cycle_hz)
        arguments = ("--can", file.model_dump_json(by_alias=True))
        side = ServedLoopback(cell, options, seed, SERVER, arguments, is_watched=False)
        super().__init__(cell, file, side, options.period_s)
        self._server = side

    def connect(self) -> None:
        """Starts the process with the drives, and connects."""
        self._server.connect()
        try:
            super().connect()
        except DriverError:
            self._server.close()
            raise


def connect(
    cell: CellDescription, options: WorldOptions | None = None, seed: int = 0, name: str = ""
) -> Driver:
    """Connected drives, stepped on virtual buses; the CAN file is called as the cell by default."""
    driver = SteppedCan(cell, load_can(name or cell.name, cell), options, seed)
    driver.connect()
    return driver


def connect_served(
    cell: CellDescription, options: WorldOptions | None = None, seed: int = 0, name: str = ""
) -> Driver:
    """Connected drives in a process of their own, over `udp_multicast`."""
    file = on_own_groups(load_can(name or cell.name, cell))
    driver = ServedCan(cell, file, options, seed)
    driver.connect()
    return driver
