"""The loopback driver: the simulated cell, stepped. Time moves only when the clock is slept on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from viskill_deploy.core.clock import Clock, SteppedClock
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import ActiveObject, CellState, FloatArray, JointSetpoint, Scene
from viskill_deploy.drivers.base import Capabilities, Driver, accepted
from viskill_deploy.drivers.loopback_cell import LoopbackCell
from viskill_deploy.drivers.watch import OwnTime, Watch
from viskill_deploy.safety.checked import CheckedSetpoint
from viskill_deploy.sim.world import World, WorldOptions


class Stepping(Protocol):
    """What a world clock moves on."""

    period_s: float

    def lateness_s(self) -> float:
        """How late the control loop wakes this time."""
        ...

    def advance(self) -> None:
        """One control period of physics."""
        ...


class WorldClock(SteppedClock):
    """Simulated time: sleeping lets the world run. The sleeper may wake late, the world does not.

    Attributes:
        world_s: time of the world, in whole control periods.
    """

    def __init__(self, driver: Stepping) -> None:
        super().__init__()
        self._driver, self.world_s = driver, super().now()

    def sleep_until(self, deadline_s: float) -> float:
        """Runs whole control periods until the deadline is reached; those that fit, if late."""
        late = self._driver.lateness_s()
        period = self._driver.period_s
        while self.world_s + (period if late else 0.0) < deadline_s + late - 1e-9:
            self._driver.advance()
            self.world_s += period
            self.advance(max(self.world_s - self.now(), 0.0))
        woken = deadline_s + late if late else self.world_s
        self.advance(max(woken - self.now(), 0.0))
        return self.now()


class LoopbackDriver:
    """The simulated cell in this process.

    Args:
        cell: the cell.
        options: period, noise, delay and what else is not perfect.
        seed: of noise, offsets and losses.
    """

    capabilities = Capabilities(simulated=True, stepped=True, resettable=True, sees_scene=True)

    def __init__(
        self, cell: CellDescription, options: WorldOptions | None = None, seed: int = 0
    ) -> None:
        self.world = World(cell.filed or cell, options, seed)  # no calibration moves a real arm
        self.period_s = self.world.options.period_s
        self._time = WorldClock(self)
        self.clock: Clock = self._time
        self.watch: Watch = OwnTime()
        self._cell: LoopbackCell | None = None

    @property
    def cell(self) -> LoopbackCell:
        """The connected cell; raises DriverError before `connect` and after `close`."""
        if self._cell is None:
            raise DriverError("the loopback is not connected; call connect() first")
        return self._cell

    def connect(self) -> None:
        """Makes the cell available, DISABLED."""
        self._cell = LoopbackCell(self.world)

    def enable(self) -> None:
        """Every arm ENABLED."""
        self.cell.enable()

    def home(self) -> None:
        """Every arm homed where it is."""
        self.cell.home()

    def hold(self) -> None:
        """Every arm stays at its setpoint."""
        self.cell.hold()

    def disable(self) -> None:
        """Every arm DISABLED."""
        self.cell.disable()

    def close(self) -> None:
        """Holds, disables and lets go of the cell."""
        if self._cell is not None:
            self._cell.disable()
        self._cell = None

    def say(self, consent: bool | None = None, estop: bool | None = None) -> None:
        """What the simulated operator does."""
        self.cell.say(consent, estop)

    def state(self) -> CellState:
        """The newest measurement."""
        state = self.cell.state(self._time.world_s)
        return CellState(state.arms, self.watch.told(state.inputs, self.clock.now()))

    def servo_jp(self, setpoints: Sequence[CheckedSetpoint]) -> None:
        """Sends one checked setpoint an arm."""
        self.cell.servo_jp(accepted(setpoints))

    def scene(self) -> Scene:
        """The objects as the simulator knows them."""
        return self.cell.scene(self._time.world_s)

    def reset(self, layout: Scene) -> None:
        """Puts objects where `layout` says and the arms in their start pose."""
        self.cell.reset(layout)

    def active_object(self) -> ActiveObject:
        """The truth about the active object, for judging success."""
        return self.world.active_object()

    def restore(self, physics: FloatArray, setpoints: Sequence[JointSetpoint]) -> None:
        """Goes to a saved moment of the scene that `reset` has set up, at rest."""
        self.cell.restore(physics, setpoints)

    def break_drive(self, joint: str, kind: str) -> None:
        """A joint's drive breaks; for tests of what happens then."""
        self.cell.break_drive(joint, kind)

    def lateness_s(self) -> float:
        """How late the control loop wakes this time."""
        return self.world.imperfections.lateness_s()

    def advance(self) -> None:
        """One control period of physics; a disconnected cell stands still."""
        if self._cell is not None:
            self._cell.advance()


def connect(cell: CellDescription, options: WorldOptions | None = None, seed: int = 0) -> Driver:
    """A connected stepped loopback."""
    driver = LoopbackDriver(cell, options, seed)
    driver.connect()
    return driver
