"""The CAN driver: CiA 402 drives in cyclic synchronous position, one bus an arm.

In every cycle each drive gets controlword and target, then a SYNC lets all of them take it and
answer with statusword and position. Whatever is wrong with a bus or a drive stops all drives (quick
stop) and is a DriverError with the drive's name, until the arms are enabled again.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import partial

from viskill_deploy.core.clock import Clock, MonotonicClock
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import ActiveObject, CellState, JointSetpoint, Scene
from viskill_deploy.drivers.base import Capabilities, Driver, accepted
from viskill_deploy.drivers.can.axis import Axis
from viskill_deploy.drivers.can.codec import Control, Drive
from viskill_deploy.drivers.can.company import Company
from viskill_deploy.drivers.can.config import CanFile
from viskill_deploy.drivers.can.coupling import Gearing
from viskill_deploy.drivers.can.inputs import InputNode
from viskill_deploy.drivers.can.line import CanLine
from viskill_deploy.drivers.can.load import check_load
from viskill_deploy.drivers.can.master import BusMaster
from viskill_deploy.drivers.can.measured import Measured, standing
from viskill_deploy.drivers.can.watch import DriveWatch
from viskill_deploy.drivers.can.wiring_check import demand_checked
from viskill_deploy.safety.checked import CheckedSetpoint

PATIENCE_S = 1.0
"""Time that drives get to answer, to change state, or to speak for the first time."""

STEPS = (
    (Control.SHUTDOWN, Drive.READY_TO_SWITCH_ON),
    (Control.SWITCH_ON, Drive.SWITCHED_ON),
    (Control.ENABLE_OPERATION, Drive.OPERATION_ENABLED),
)
"""Controlwords 6, 7, 15, and the state that each has to lead to."""

LISTEN_S = 0.0005
COMPANY = 1.5
"""Periods without a cycle of the runtime after which a driver at rest sends one by itself."""


class CanDriver:
    """Arms on CAN.

    Args:
        cell: the arms; the instrument's coupling comes from here.
        file: buses, drives, times.
        source: how the gate calls who agrees to motion.
        period_s: control period; the file's when left out.

    Attributes:
        load: part of the time in which each arm's bus is taken.
        exchanges: SYNCs sent.
        cycles, late: those while arms moved, and how many of them came outside the window.

    Raises:
        DriverError: a bus would carry more than it may.
    """

    capabilities = Capabilities(simulated=False, stepped=False, resettable=False, sees_scene=False)

    def __init__(
        self,
        cell: CellDescription,
        file: CanFile,
        source: str = "CAN",
        period_s: float | None = None,
    ) -> None:
        self.clock: Clock = MonotonicClock()
        self.period_s = period_s or 1.0 / file.cycle_hz
        self.load = {
            bus.arm: check_load(bus.arm, file.traffic(bus, self.period_s)) for bus in file.bus
        }
        self._file, self._source = file, source
        self._measured = Measured(cell, self.period_s)
        self._gearings = [
            Gearing(arm.arm, bus) for arm, bus in zip(cell.arms, file.bus, strict=True)
        ]
        self.masters: list[BusMaster] = []
        self._drive_watch = DriveWatch(self._all_axes)
        self._lock = threading.RLock()
        self._company: Company | None = None
        self._is_enabled = self._is_homed = False
        self._held: list[JointSetpoint] = []
        self._sync_s, self._trouble = -1.0, ""
        self.cycles = self.late = self.exchanges = 0

    @property
    def watch(self) -> DriveWatch:
        """The drives themselves; there is no connection without them."""
        self._connected()
        return self._drive_watch

    def connect(self) -> None:
        """Opens the buses, configures every drive and reads it back; arms stay DISABLED.

        Raises:
            DriverError: a bus or a drive is not as it has to be; names it.
        """
        file = self._file
        self._input = InputNode(file.input.node_id, file.heartbeat_s, self._source)
        try:
            for bus, gearing in zip(file.bus, self._gearings, strict=True):
                is_fd = bus.data_bitrate_bit_s is not None
                line = CanLine(bus.arm, file.interface, bus.channel, is_fd)
                master = BusMaster(file, bus, gearing, line)
                self.masters.append(master)
                if bus.arm == file.input.bus:
                    master.hearers[self._input.feedback_id] = self._input.hear_word
                    master.hearers[self._input.heartbeat_id] = self._input.hear_heartbeat
            for master in self.masters:
                master.configure(self.period_s, self.pause)
            self._restart()
            self._until(lambda: not self._silent())
        except DriverError:
            self._let_go()
            raise
        if not self.capabilities.stepped:
            self._company = Company(self._accompany, self.clock, self.period_s)

    def enable(self) -> None:
        """Switches every drive on, one controlword after the other, where it is.

        Raises:
            DriverError: a drive does not follow; names it and its state.
        """
        self._connected()
        with self._lock:
            self._recover()
            for control, state in STEPS:
                self._stay()
                self._command(control)
                self._until(partial(self._all_in, state), state)
            self._held = standing(self.masters)
            self._is_enabled = True

    def home(self) -> None:
        """Takes the encoders' word for where the joints are: they have to be absolute.

        Raises:
            DriverError: the arms are not enabled.
        """
        if not self._is_enabled:
            raise DriverError("home is not possible while arms are disabled; enable them first")
        self._is_homed = True

    def hold(self) -> None:
        """Every arm stays at the setpoint that it holds; drives repeat their target anyway."""
        self._connected()

    def disable(self) -> None:
        """Takes power from every drive."""
        self._connected()
        with self._lock:
            self._is_enabled = False
            self._command(Control.DISABLE_VOLTAGE)
            for _ in range(2):
                self._pass_period()

    def close(self) -> None:
        """Takes power and closes the buses; may be called twice."""
        if self.masters:
            try:
                self.disable()
            except DriverError as error:
                self._trouble = str(error)  # a bus that is gone: the drives stop by themselves
        self._let_go()

    def state(self) -> CellState:
        """The newest measurement.

        Raises:
            DriverError: a bus or a drive is not as it has to be; all drives are being stopped.
        """
        self._connected()
        with self._lock:
            self._listen()
            self._look()
            now = self.clock.now()
            self._measured.update(self.masters)
            if not self._is_enabled:
                self._held = standing(self.masters)
            arms = self._measured.arms(self._held, self._is_enabled, self._is_homed)
            return CellState(arms, self._drive_watch.told(self._input.inputs(now), now))

    def servo_jp(self, setpoints: Sequence[CheckedSetpoint]) -> None:
        """Sends one checked setpoint an arm.

        Raises:
            DriverError: arms are not ready, or a bus takes nothing.
        """
        wanted = accepted(setpoints)
        self._connected()
        with self._lock:
            if self._trouble:
                raise DriverError(self._trouble)
            if not (self._is_enabled and self._is_homed):
                raise DriverError("servo_jp: arms not ready; enable and home them")
            if len(wanted) != len(self.masters):
                raise DriverError(f"servo_jp: {len(wanted)} setpoints for {len(self.masters)} arms")
            for master, setpoint in zip(self.masters, wanted, strict=True):
                master.target(setpoint)
            self._held = wanted
            self._exchange()

    def scene(self) -> Scene | None:
        """Drives see no objects."""
        return None

    def say(self, consent: bool | None = None, estop: bool | None = None) -> None:
        """Only a person agrees to motion here."""
        raise DriverError("arms on CAN have no simulated operator; use the input node")

    def break_drive(self, joint: str, kind: str) -> None:
        """Only simulated drives can be broken."""
        raise DriverError("only a simulated drive can be broken on purpose")

    def active_object(self) -> ActiveObject:
        """Drives see no objects."""
        raise DriverError("arms on CAN do not know the truth about objects; use the loopback")

    def reset(self, layout: Scene) -> None:
        """Nobody puts real objects in place."""
        raise DriverError("a real cell is not reset; put the objects in place by hand")

    def pause(self) -> None:
        """Lets a moment pass in which a drive may answer a question."""
        self.clock.sleep_until(self.clock.now() + LISTEN_S)

    def keep(self) -> None:
        """A cycle with the targets that the drives have."""
        with self._lock:
            self._listen()
            self._exchange()

    def _connected(self) -> None:
        if not self.masters:
            raise DriverError("the arms on CAN are not connected; call connect() first")

    def _all_axes(self) -> list[Axis]:
        return [axis for master in self.masters for axis in master.axes]

    def _all_in(self, state: Drive) -> bool:
        return all(master.all_in(state) for master in self.masters)

    def _command(self, control: int) -> None:
        for master in self.masters:
            master.command(control)

    def _stay(self) -> None:
        for master in self.masters:
            master.stay()

    def _recover(self) -> None:
        """Every drive without power and without fault, and what was wrong forgotten."""
        self._is_enabled = False
        off = Drive.SWITCH_ON_DISABLED
        for control in (Control.DISABLE_VOLTAGE, Control.FAULT_RESET, Control.DISABLE_VOLTAGE):
            self._command(control)
            for _ in range(2):
                self._pass_period()
        self._restart()
        self._until(lambda: self._all_in(off), off)

    def _silent(self) -> str:
        """Who has said nothing since the connection was made; "" when all have spoken."""
        for axis in self._all_axes():
            if axis.reading is None:
                return axis.name
        return "" if self._input.has_spoken else f"input node {self._file.input.node_id}"

    def _until(self, done: Callable[[], bool], wanted: Drive | None = None) -> None:
        """Cycles until something is so, for a message: that all drives are in a state.

        Raises:
            DriverError: it is not so in time, or something else is wrong.
        """
        deadline = self.clock.now() + PATIENCE_S
        while not done():
            if self.clock.now() > deadline:
                self._command(Control.DISABLE_VOLTAGE)
                late = self._straggler(wanted) if wanted else f"{self._silent()} says nothing"
                raise DriverError(f"{late} within {PATIENCE_S} s; look at its display and plug")
            self._pass_period()
            self._look()

    def _straggler(self, wanted: Drive) -> str:
        """The first drive that is not in a state, for a message."""
        for axis in self._all_axes():
            state = axis.reading.state if axis.reading else None
            if state is not wanted:
                is_in = state.name if state else "no state"
                return f"{axis.name} is in {is_in} and does not come to {wanted.name}"
        return "a drive is late"

    def _pass_period(self) -> None:
        """One cycle, and time for its answers."""
        with self._lock:
            self._exchange()
            self.clock.sleep_until(self._sync_s + self.period_s)
            self._listen()

    def _exchange(self) -> None:
        now = self.clock.now()
        if self._drive_watch.is_moving:
            self.cycles += 1
            off = abs(now - self._sync_s - self.period_s)
            self.late += off > self._file.sync_window_s
        self._sync_s, self.exchanges = now, self.exchanges + 1
        for master in self.masters:
            master.cycle(now)

    def _listen(self) -> None:
        now = self.clock.now()
        for master in self.masters:
            master.listen(now)

    def _look(self) -> None:
        now = self.clock.now()
        for master in self.masters:
            found = master.look(now, self._is_enabled)
            self._trouble = self._trouble or found
        if self._trouble:
            self._stop_all()
            raise DriverError(self._trouble)

    def _stop_all(self) -> None:
        """Quick stop of every drive that can be reached."""
        if self._is_enabled:
            self._command(Control.QUICK_STOP)
        for master in self.masters:
            try:
                master.cycle(self.clock.now())
            except DriverError:  # the first trouble is the one that counts
                continue

    def _restart(self) -> None:
        now = self.clock.now()
        self._trouble, self._is_enabled = "", False
        for master in self.masters:
            master.restart(now)

    def _accompany(self) -> None:
        """A cycle in the runtime's place, if it is late and the arms are at rest."""
        if self._drive_watch.is_moving:
            return
        with self._lock:
            is_late = self.clock.now() - self._sync_s > COMPANY * self.period_s
            if is_late and not self._drive_watch.is_moving:
                try:
                    self.keep()
                except DriverError as error:
                    self._trouble = self._trouble or str(error)

    def _let_go(self) -> None:
        if self._company is not None:
            self._company.close()
            self._company = None
        with self._lock:
            masters, self.masters = self.masters, []
            for master in masters:
                master.line.close()
            self._is_enabled = self._is_homed = False


def connect(cell: CellDescription, file: CanFile) -> Driver:
    """Connected arms on CAN, for a run.

    Raises:
        DriverError: their axes have not been tried with small motions, or they cannot be connected.
    """
    demand_checked(cell, file)
    driver = CanDriver(cell, file)
    driver.connect()
    return driver
