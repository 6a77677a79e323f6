"""The master of one bus: an arm's seven drives, told together and understood together."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from viskill_deploy.core.types import JointSetpoint
from viskill_deploy.drivers.can.axis import OPERATIONAL, Axis
from viskill_deploy.drivers.can.codec import (
    EMCY_ID,
    HEARTBEAT_ID,
    NMT_ID,
    RPDO_ID,
    SDO_REQUEST_ID,
    SYNC_ID,
    Cia402Codec,
    Drive,
)
from viskill_deploy.drivers.can.config import Bus, CanFile
from viskill_deploy.drivers.can.coupling import Gearing
from viskill_deploy.drivers.can.line import CanLine, Frame
from viskill_deploy.drivers.can.objects import axis_objects
from viskill_deploy.drivers.can.sdo import DriveDictionary

START, PRE_OPERATIONAL = 0x01, 0x80
"""NMT commands."""
SETTLE = 20

Hearer = Callable[[bytes, float], None]


class BusMaster:
    """One arm on its bus.

    Args:
        file: times and node ids.
        bus: the arm's drives.
        gearing: between its joints and their counts.
        line: the open bus.

    Attributes:
        axes: the drives, jaw last.
        trouble: the first thing that is wrong; "" when all is well.
    """

    def __init__(self, file: CanFile, bus: Bus, gearing: Gearing, line: CanLine) -> None:
        self.gearing, self.line, self.trouble = gearing, line, ""
        self._file, self._bus, self._beat_due_s = file, bus, 0.0
        self.axes = [
            Axis(
                f"{bus.arm} {axis.joint} (node {axis.node_id})",
                Cia402Codec(axis.node_id),
                file.heartbeat_s,
            )
            for axis in bus.axis
        ]
        self.hearers: dict[int, Hearer] = {}
        for entry, axis in zip(bus.axis, self.axes, strict=True):
            node = entry.node_id
            self.hearers[axis.codec.feedback_id] = axis.hear_feedback
            self.hearers[HEARTBEAT_ID + node] = axis.hear_heartbeat
            self.hearers[EMCY_ID + node] = partial(_without_time, axis.hear_emergency)
            for base in (RPDO_ID, SDO_REQUEST_ID):
                self.hearers[base + node] = partial(self._hear_stranger, base + node)
        for mine in (NMT_ID, SYNC_ID, HEARTBEAT_ID + file.master_node_id):
            self.hearers[mine] = partial(self._hear_stranger, mine)

    def configure(self, period_s: float, wait: Callable[[], None]) -> None:
        """Writes every drive's objects and reads them back; then the drives are operational.

        Args:
            period_s: control period.
            wait: lets a moment pass.

        Raises:
            DriverError: a drive does not answer, refuses, or does not keep what it is told.
        """

        def listen() -> list[Frame]:
            wait()
            return self.line.drain()

        self._tell_all(PRE_OPERATIONAL)
        listen()
        for entry, axis in zip(self._bus.axis, self.axes, strict=True):
            drive = DriveDictionary(self.line, entry.node_id, axis.name, listen)
            drive.configure(axis_objects(self._file, entry, period_s))
        self._tell_all(START)
        for _ in range(SETTLE):
            listen()  # what they said before they were started

    def cycle(self, now: float) -> None:
        """Tells every drive its target, and then all of them to take it.

        Raises:
            DriverError: the bus takes no frames.
        """
        send = self.line.send
        if now >= self._beat_due_s:
            self._beat_due_s = now + self._file.heartbeat_s
            send(HEARTBEAT_ID + self._file.master_node_id, bytes([OPERATIONAL]))
        for axis in self.axes:
            send(axis.codec.command_id, axis.command(), cyclic=True)
        send(SYNC_ID, b"")

    def listen(self, now: float) -> None:
        """Hears everything that has arrived."""
        hearers = self.hearers
        for can_id, data in self.line.drain():
            hearer = hearers.get(can_id)
            if hearer is None:
                self.line.foreign += 1
            else:
                hearer(data, now)

    def look(self, now: float, is_enabled: bool) -> str:
        """What is wrong with bus or drives; "" when all is well."""
        for axis in self.axes:
            axis.look(now, is_enabled)
        found = (self.line.trouble, *(axis.trouble for axis in self.axes))
        self.trouble = self.trouble or next(filter(None, found), "")
        return self.trouble

    def restart(self, now: float) -> None:
        """Forgets what was wrong."""
        self.trouble = self.line.trouble = ""
        for axis in self.axes:
            axis.restart(now)

    def all_in(self, state: Drive) -> bool:
        """Whether every drive says that it is in this state."""
        return all(axis.reading is not None and axis.reading.state is state for axis in self.axes)

    def command(self, control: int) -> None:
        """The controlword of every drive from the next cycle on."""
        for axis in self.axes:
            axis.control = control

    def target(self, setpoint: JointSetpoint) -> None:
        """The targets from the next cycle on."""
        counts = self.gearing.counts((*setpoint.jp, setpoint.jaw))
        for axis, count in zip(self.axes, counts, strict=True):
            axis.target = count

    def stay(self) -> None:
        """The targets are where the drives are."""
        for axis in self.axes:
            if axis.reading is not None:
                axis.target = axis.reading.counts

    def joints(self) -> list[float]:
        """Measured joints (7,), jaw last; zeros stand for drives that said nothing yet."""
        return self.gearing.joints_of_counts(
            [axis.reading.counts if axis.reading else 0 for axis in self.axes]
        )

    @property
    def stamp_s(self) -> float:
        """When the drive that was heard longest ago was heard."""
        return min([axis.stamp_s for axis in self.axes])

    def _tell_all(self, command: int) -> None:
        for entry in self._bus.axis:
            self.line.send(NMT_ID, bytes([command, entry.node_id]))

    def _hear_stranger(self, can_id: int, data: bytes, now: float) -> None:
        """A frame that only the master of this bus sends, and this master did not."""
        del data, now
        if not self.trouble:
            self.trouble = (
                f"bus of {self._bus.arm}: somebody else commands (frame 0x{can_id:03X}); take the "
                "other master off the bus and enable the arms again"
            )


def _without_time(hear: Callable[[bytes], None], data: bytes, now: float) -> None:
    del now
    hear(data)
