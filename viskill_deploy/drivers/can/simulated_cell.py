"""The loopback's cell behind CiA 402 drives: what hangs on the buses of a simulated robot."""

from __future__ import annotations

from typing import Any

from viskill_deploy.core.description import CellArm
from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import ArmState, JointSetpoint
from viskill_deploy.drivers.can.codec import (
    HEARTBEAT_ID,
    NMT_ID,
    RPDO_ID,
    SDO_REQUEST_ID,
    SYNC_ID,
    TPDO_ID,
)
from viskill_deploy.drivers.can.config import INPUT_PERIOD_S, Bus, CanFile
from viskill_deploy.drivers.can.coupling import Gearing
from viskill_deploy.drivers.can.inputs import pack_input
from viskill_deploy.drivers.can.line import CanLine
from viskill_deploy.drivers.can.simulated_drive import OPERATIONAL, POWERED, SimulatedDrive
from viskill_deploy.drivers.loopback_cell import LoopbackCell


class ArmOfDrives:
    """One arm's drives on their bus.

    Args:
        arm: the arm; what its instrument really is.
        bus: how its drives are really wired.
        line: the open bus.
    """

    def __init__(self, arm: CellArm, bus: Bus, line: CanLine) -> None:
        self.line, self.gearing = line, Gearing(arm.arm, bus)
        self.drives = [SimulatedDrive(axis.node_id) for axis in bus.axis]
        self._scales = [axis.sign * axis.scale for axis in bus.axis]

    def poll(self, now: float) -> None:
        """Lets the drives hear what has arrived, and say what they have to."""
        for can_id, data in self.line.drain():
            self._hear(can_id, data, now)
        self.speak()

    def _hear(self, can_id: int, data: bytes, now: float) -> None:
        kind, node = can_id & 0x780, can_id & 0x7F
        if can_id == NMT_ID:
            for drive in self.drives:
                drive.hear_nmt(data)
        elif can_id == SYNC_ID:
            for drive in self.drives:
                drive.hear_sync(now)
        elif kind == HEARTBEAT_ID:
            for drive in self.drives:
                drive.hear_heartbeat(node, now)
        elif kind in {RPDO_ID, SDO_REQUEST_ID}:
            for drive in self.drives:
                if drive.node_id == node and kind == RPDO_ID:
                    drive.hear_target(data, now)
                elif drive.node_id == node:
                    drive.hear_sdo(data)

    def speak(self) -> None:
        """Sends what the drives have to say."""
        for drive in self.drives:
            for can_id, data in drive.take():
                self.line.send(can_id, data, cyclic=can_id & 0x780 == TPDO_ID)

    def tick(self, now: float, dt_s: float) -> None:
        """A moment passes for every drive."""
        for drive in self.drives:
            drive.tick(now, dt_s)
        self.speak()

    @property
    def has_power(self) -> bool:
        """Whether any drive holds its joint; otherwise the brakes do."""
        return any(drive.state in POWERED for drive in self.drives)

    def demand(self) -> JointSetpoint:
        """Where the drives drive the joints."""
        q = self.gearing.joints_of_counts([drive.demand for drive in self.drives])
        pairs = zip(self.drives, self._scales, strict=True)
        v = self.gearing.joints([drive.speed / scale for drive, scale in pairs])
        return JointSetpoint(tuple(q[:6]), tuple(v[:6]), q[6], v[6])

    def feel(self, arm: ArmState) -> None:
        """The encoders read where the arm is."""
        counts = self.gearing.counts((*arm.measured_jp, arm.jaw_measured_jp))
        for drive, count in zip(self.drives, counts, strict=True):
            drive.actual = count


class DriveCell:
    """Drives and input node in front of a simulated cell.

    Args:
        cell: the arms as they are.
        file: how they are wired; a bus of python-can is opened for each.

    Attributes:
        arms: their drives.
        input_is_mute: the input node says nothing; for tests.
    """

    def __init__(self, cell: LoopbackCell, file: CanFile) -> None:
        self.cell, self._file = cell, file
        world = cell.world
        self._lines = [
            CanLine(bus.arm, file.interface, bus.channel, bus.data_bitrate_bit_s is not None)
            for bus in file.bus
        ]
        rows = zip(world.cell.arms, file.bus, self._lines, strict=True)
        self.arms = [ArmOfDrives(arm, bus, line) for arm, bus, line in rows]
        self._held = [arm.demand() for arm in self.arms]
        self._word_due_s = self._beat_due_s = 0.0
        self._words, self.input_is_mute = 0, False
        self._line_of_input = self._lines[[b.arm for b in file.bus].index(file.input.bus)]
        cell.enable()
        cell.home()
        self._feel(0.0)

    @property
    def lines(self) -> list[CanLine]:
        """The buses, to wait on."""
        return self._lines

    def poll(self, now: float) -> None:
        """Hears and answers; no time passes."""
        for arm in self.arms:
            arm.poll(now)

    def advance(self, now: float) -> None:
        """One control period of drives and physics, which ends at `now`."""
        period = self.cell.world.options.period_s
        self.poll(now)
        for arm in self.arms:
            arm.tick(now, period)
        self._say_inputs(now)
        if any(arm.has_power for arm in self.arms):
            states = self.cell.state(now).arms
            self.cell.servo_jp(
                [
                    arm.demand() if arm.has_power else _where_it_is(state)
                    for arm, state in zip(self.arms, states, strict=True)
                ]
            )
        self.cell.advance()
        self._feel(now)

    def cause(self, fault: str, arm: str, is_on: bool) -> None:
        """Drives are broken one by one, with `break_drive`."""
        del arm, is_on
        raise DriverError(f"drives have no fault {fault!r}; break one with break_drive")

    def heard(self) -> dict[str, Any]:
        """Drives do not count."""
        return {}

    def close(self) -> None:
        """Lets go of the buses."""
        for line in self._lines:
            line.close()

    def _feel(self, now: float) -> None:
        for arm, state in zip(self.arms, self.cell.state(now).arms, strict=True):
            arm.feel(state)

    def _say_inputs(self, now: float) -> None:
        if self.input_is_mute:
            return
        node, line = self._file.input.node_id, self._line_of_input
        if now >= self._beat_due_s:
            self._beat_due_s = now + self._file.heartbeat_s
            line.send(HEARTBEAT_ID + node, bytes([OPERATIONAL]))
        if now >= self._word_due_s:
            self._word_due_s = now + INPUT_PERIOD_S
            inputs = self.cell.state(now).inputs
            self._words += 1
            line.send(TPDO_ID + node, pack_input(inputs.consent, inputs.estop, self._words))


def _where_it_is(state: ArmState) -> JointSetpoint:
    """Brakes hold an arm where its setpoint was."""
    return JointSetpoint(state.setpoint_jp, (0.0,) * 6, state.jaw_setpoint_jp, 0.0)
