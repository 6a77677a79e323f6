"""The CRTK driver on simulated dVRK arms: stepped in this process, or in one of their own."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from typing import Any, Final

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import FloatArray, JointSetpoint, Scene
from viskill_deploy.drivers.base import Capabilities, Driver
from viskill_deploy.drivers.crtk.driver import CrtkDriver, CrtkOptions
from viskill_deploy.drivers.crtk.inproc import Exchange, Inproc
from viskill_deploy.drivers.crtk.opening import Network, open_transport
from viskill_deploy.drivers.crtk.private_network import PrivateNetwork
from viskill_deploy.drivers.crtk.simulated_cell import CrtkCell, ServerOptions
from viskill_deploy.drivers.crtk.transport import Transport
from viskill_deploy.drivers.crtk.watchdog import start_watch
from viskill_deploy.drivers.loopback import WorldClock
from viskill_deploy.drivers.loopback_cell import LoopbackCell
from viskill_deploy.drivers.loopback_served import ServedLoopback
from viskill_deploy.drivers.sides import SIMULATED, Side, SteppedSide, WithSide
from viskill_deploy.drivers.watch import OwnTime, Watch
from viskill_deploy.sim.world import World, WorldOptions

SERVER: Final = "viskill_deploy.drivers.crtk.server"

PERIOD_S: Final = 0.005
"""200 Hz; dVRK's own loop is faster, its feedback is not."""

ARRIVAL_S: Final = 1.0
"""How long the arms' word on where they were put may take."""


class SimulatedCrtk(WithSide, CrtkDriver):
    """The CRTK driver of a simulated cell; everything but `side` goes over the transport."""

    capabilities = Capabilities(simulated=True, stepped=False, resettable=True, sees_scene=True)

    def __init__(
        self,
        cell: CellDescription,
        transport: Transport,
        period_s: float,
        side: Side,
        start_watch: Callable[[], Watch],
    ) -> None:
        options = CrtkOptions(period_s=period_s, source=SIMULATED)
        super().__init__(cell, transport, options, start_watch)
        self.side = side

    def reset(self, layout: Scene) -> None:
        """Puts objects where `layout` says and the arms at home; power and states stay.

        Who does that has looked at the arms: a fault is over.
        """
        self._connected()
        if self._doubts.fault:
            self.recover()
        self._doubts.end_stream()
        self.side.reset(layout)
        began = self.clock.now() + self.period_s
        self._until(lambda: all(arm.stamp_s > began for arm in self.arms), ARRIVAL_S, self._unheard)

    def close(self) -> None:
        """Holds, disables, and ends the simulation."""
        super().close()
        self.side.close()


class SteppedCrtk(SimulatedCrtk):
    """dVRK arms in this process; time moves only when the clock is slept on.

    Args:
        cell: the cell as the runtime believes it to be.
        options: period, noise, delay and what else is not perfect.
        seed: of noise, offsets and losses.
        server: how the simulated dVRK behaves.

    Attributes:
        front: the arms on the wire.
        exchange: the network between them and the driver.
    """

    capabilities = Capabilities(simulated=True, stepped=True, resettable=True, sees_scene=True)

    def __init__(
        self,
        cell: CellDescription,
        options: WorldOptions | None = None,
        seed: int = 0,
        server: ServerOptions | None = None,
    ) -> None:
        options = options or WorldOptions(period_s=PERIOD_S)
        self.world = World(cell.filed or cell, options, seed)  # no calibration moves a real arm
        self.period_s = options.period_s
        self._time = WorldClock(self)
        self.exchange = Exchange(self._time)
        loopback = LoopbackCell(self.world)
        arms = server or ServerOptions(homing="stay")
        self.front = CrtkCell(loopback, Inproc(self.exchange), arms)
        side = SteppedSide(loopback, self._time, self.front.close)
        super().__init__(cell, Inproc(self.exchange), options.period_s, side, OwnTime)
        self.clock = self._time

    def advance(self) -> None:
        """One control period of arms and physics."""
        self.front.advance(self._time.world_s)

    def lateness_s(self) -> float:
        """How late the control loop wakes this time."""
        return self.world.imperfections.lateness_s()

    def restore(self, physics: FloatArray, setpoints: list[JointSetpoint]) -> None:
        """Goes to a saved moment of the scene that `reset` has set up, at rest."""
        self.front.cell.restore(physics, setpoints)


def served_arms(
    cell: CellDescription,
    transport: str,
    network: Network,
    options: WorldOptions | None = None,
    seed: int = 0,
    server: ServerOptions | None = None,
) -> ServedLoopback:
    """Simulated dVRK arms in a process of their own; `connect` starts it.

    Args:
        cell: the cell; the process loads its file.
        transport: name of the transport that they speak.
        network: where.
        options: period, noise, delay and what else is not perfect.
        seed: of noise, offsets and losses.
        server: how the simulated dVRK behaves.
    """
    arms = asdict(server or ServerOptions(homing="stay"))
    arguments = ["--transport", transport, "--network", json.dumps(asdict(network))]
    arguments += ["--crtk", json.dumps(arms)]
    return ServedLoopback(cell, options, seed, SERVER, arguments, is_watched=False)


class ServedCrtk(SimulatedCrtk):
    """dVRK arms in a process of their own, in real time.

    Args:
        cell: the cell.
        transport: name of the transport between the driver and the arms.
        network: where they are.
        side: the arms' process.
        period_s: control period.
    """

    def __init__(
        self, cell: CellDescription, transport: str, network: Network, side: Side, period_s: float
    ) -> None:
        names = [arm.name for arm in cell.arms]
        start = partial(start_watch, names, transport, network)
        super().__init__(cell, open_transport(transport, network), period_s, side, start)


class PrivateCrtk(ServedCrtk):
    """The same with a process and a network that nobody else knows.

    Args:
        cell: the cell.
        transport: name of the transport between the driver and the arms.
        options: period, noise, delay and what else is not perfect.
        seed: of noise, offsets and losses.

    Attributes:
        network: where the arms are, for whoever wants to listen too.
        server: their process and its private socket.
    """

    def __init__(
        self,
        cell: CellDescription,
        transport: str = "dds",
        options: WorldOptions | None = None,
        seed: int = 0,
    ) -> None:
        options = options or WorldOptions(period_s=PERIOD_S)
        self._private = PrivateNetwork(transport)
        self.network = self._private.network
        self.server = served_arms(cell, transport, self.network, options, seed)
        super().__init__(cell, transport, self.network, self.server, options.period_s)

    def on_the_way(self) -> dict[str, Any]:
        """With what the arms have heard; before it is closed."""
        ours = super().on_the_way()
        if not ours:
            return {}
        heard = self.server.heard()
        return {**ours, **heard, "lost": ours["sent"] - heard["heard"]}

    def connect(self) -> None:
        """Starts the process with the arms, and connects."""
        self.server.connect()
        super().connect()

    def close(self) -> None:
        """Holds, disables, and ends the process."""
        super().close()
        self._private.close()


def connect(cell: CellDescription, options: WorldOptions | None = None, seed: int = 0) -> Driver:
    """Connected dVRK arms, stepped in this process."""
    driver = SteppedCrtk(cell, options, seed)
    driver.connect()
    return driver


def connect_served(
    cell: CellDescription,
    options: WorldOptions | None = None,
    seed: int = 0,
    transport: str = "dds",
) -> Driver:
    """Connected dVRK arms in a process of their own."""
    driver = PrivateCrtk(cell, transport, options, seed)
    driver.connect()
    return driver
