"""A simulated CiA 402 drive: what a master meets on the bus, and no more physics than ramps.

Cyclic synchronous position, SDO (expedited), NMT, heartbeat, emergency, and every supervision that
docs/can.md asks of a drive. All supervision is off until its object is written, as in real drives.
The quick stop is left by taking the voltage away only (the standard leaves transition 16 open).
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

from viskill_deploy.drivers.can.codec import (
    EMCY_ID,
    HEARTBEAT_ID,
    RPDO_ID,
    SDO_ANSWER_ID,
    TPDO_ID,
    Drive,
)
from viskill_deploy.drivers.can.line import Frame
from viskill_deploy.drivers.can.objects import (
    CYCLIC_SYNCHRONOUS_POSITION,
    OFF,
    QUICK_STOP,
    RAMP_DOWN,
    STAY_IN_QUICK_STOP,
)

PRE_OPERATIONAL, OPERATIONAL, STOPPED = 127, 5, 4
NMT = {0x01: OPERATIONAL, 0x02: STOPPED, 0x80: PRE_OPERATIONAL}
RESET = (0x81, 0x82)

HEARTBEAT_LOST, TARGET_LATE, SYNC_LOST = 0x8130, 0x8250, 0x8700
FOLLOWING_ERROR, OUT_OF_RANGE, TOO_FAST = 0x8611, 0x8612, 0x8400

NO_OBJECT, NO_SUB, READ_ONLY, WRONG_SIZE, NO_COMMAND = (
    0x06020000,
    0x06090011,
    0x06010002,
    0x06070010,
    0x05040001,
)

POWERED = (Drive.OPERATION_ENABLED, Drive.QUICK_STOP_ACTIVE, Drive.FAULT_REACTION_ACTIVE)
RAMPING = (Drive.QUICK_STOP_ACTIVE, Drive.FAULT_REACTION_ACTIVE)

_PDO, _SDO = struct.Struct("<Hi"), struct.Struct("<BHB4s")
_WRITE_SIZES = {0x2F: 1, 0x2B: 2, 0x27: 3, 0x23: 4}
_READ_COMMANDS = {1: 0x4F, 2: 0x4B, 4: 0x43}


@dataclass(slots=True)
class Entry:
    """One entry of the dictionary."""

    size: int
    is_signed: bool
    value: int
    is_read_only: bool = False


def _fresh(node: int) -> dict[tuple[int, int], Entry]:
    off = OFF
    u1, u2, u4 = (1, False), (2, False), (4, False)
    plain = {
        (0x1006, 0): u4,
        (0x1007, 0): u4,
        (0x1016, 1): u4,
        (0x1017, 0): u2,
        (0x1029, 1): u1,
        (0x1400, 2): u1,
        (0x1400, 5): u2,
        (0x1600, 0): u1,
        (0x1600, 1): u4,
        (0x1600, 2): u4,
        (0x1800, 2): u1,
        (0x1A00, 0): u1,
        (0x1A00, 1): u4,
        (0x1A00, 2): u4,
        (0x6007, 0): (2, True),
        (0x605A, 0): (2, True),
        (0x605E, 0): (2, True),
        (0x6060, 0): (1, True),
        (0x6065, 0): u4,
        (0x6066, 0): u2,
        (0x6072, 0): u2,
        (0x607D, 1): (4, True),
        (0x607D, 2): (4, True),
        (0x6080, 0): u4,
        (0x6085, 0): u4,
        (0x60C2, 1): u1,
        (0x60C2, 2): (1, True),
    }
    entries = {key: Entry(size, signed, 0) for key, (size, signed) in plain.items()}
    entries |= {
        (0x1000, 0): Entry(4, False, 0x0002_0192, True),
        (0x1001, 0): Entry(1, False, 0, True),
        (0x1018, 0): Entry(1, False, 1, True),
        (0x1018, 1): Entry(4, False, 0, True),
        (0x1400, 1): Entry(4, False, off | RPDO_ID + node),
        (0x1800, 1): Entry(4, False, off | TPDO_ID + node),
        (0x603F, 0): Entry(2, False, 0, True),
        (0x6041, 0): Entry(2, False, 0, True),
        (0x6061, 0): Entry(1, True, 0, True),
        (0x6064, 0): Entry(4, True, 0, True),
    }
    return entries


class SimulatedDrive:
    """A drive.

    Args:
        node_id: its number.

    Attributes:
        state: of CiA 402.
        nmt: of CANopen.
        actual: measured position, counts; its world writes it.
        demand: where it drives to, counts; speed: how fast that moves, counts/s.
        deaf: entries that keep their value when they are written; for tests.
        is_mute: nothing of it reaches the bus; for tests.
    """

    def __init__(self, node_id: int) -> None:
        self.node_id = node_id
        self.deaf: set[tuple[int, int]] = set()
        self.is_mute = False
        self.actual = 0
        self._start()

    def _start(self) -> None:
        self.entries = _fresh(self.node_id)
        self.state, self.nmt, self.demand, self.speed = Drive.SWITCH_ON_DISABLED, 0, 0.0, 0.0
        self._control, self._latched = 0, (0, 0)
        self._has_target = False
        self._beat_due_s = self._erring_since_s = -math.inf
        self._synced_s = self._told_s = self._master_s = -math.inf
        self._outbox: list[Frame] = []

    def value(self, index: int, sub: int = 0) -> int:
        """What an entry holds."""
        return self.entries[index, sub].value

    def take(self) -> list[Frame]:
        """What it has to say since last asked."""
        frames, self._outbox = self._outbox, []
        return [] if self.is_mute else frames

    def hear_nmt(self, data: bytes) -> None:
        """A command of the network's master."""
        if len(data) != 2 or data[1] not in {0, self.node_id}:
            return
        if data[0] in RESET:
            self._start()
        elif data[0] in NMT:
            self.nmt = NMT[data[0]]
            if self.nmt != OPERATIONAL:
                self._lose_master()

    def hear_heartbeat(self, node: int, now: float) -> None:
        """Somebody's heartbeat; that of its master is watched from then on."""
        if node == self.value(0x1016, 1) >> 16:
            self._master_s = now

    def hear_target(self, data: bytes, now: float) -> None:
        """RPDO 1; it counts at the next SYNC."""
        is_on = not self.value(0x1400, 1) & OFF and self.value(0x1600) == 2
        if self.nmt == OPERATIONAL and is_on and len(data) == _PDO.size:
            self._latched, self._has_target, self._told_s = _PDO.unpack(data), True, now

    def hear_sync(self, now: float) -> None:
        """Takes the target and answers."""
        if self.nmt != OPERATIONAL:
            return
        if self._has_target:
            control, target = self._latched
            self._has_target = False
            self._obey(control)
            if self.state is Drive.OPERATION_ENABLED:
                self._drive_to(target)
        self._synced_s = now
        if not self.value(0x1800, 1) & OFF and self.value(0x1A00) == 2:
            data = _PDO.pack(self.state.value[1] | 0x0200, self.actual)
            self._outbox.append((TPDO_ID + self.node_id, data))

    def tick(self, now: float, dt_s: float) -> None:
        """A moment passes: heartbeat, ramps, supervision."""
        if self.nmt == 0:
            self._outbox.append((HEARTBEAT_ID + self.node_id, b"\0"))
            self.nmt = PRE_OPERATIONAL
        beat_s = self.value(0x1017) / 1e3
        if beat_s and now >= self._beat_due_s:
            self._beat_due_s = now + beat_s
            self._outbox.append((HEARTBEAT_ID + self.node_id, bytes([self.nmt])))
        if self.state not in POWERED:
            self.demand, self.speed = float(self.actual), 0.0
        elif self.state in RAMPING:
            self._ramp(dt_s)
        else:
            self._supervise(now)

    def fail(self, code: int) -> None:
        """Goes into fault, and says why."""
        self._say(code)
        self.entries[0x603F, 0].value = code
        is_ramped = self.state in POWERED and self.value(0x605E) == RAMP_DOWN
        self.state = Drive.FAULT_REACTION_ACTIVE if is_ramped else Drive.FAULT

    def _say(self, code: int) -> None:
        data = struct.pack("<HB5x", code, code != 0)
        self._outbox.append((EMCY_ID + self.node_id, data))

    def _drive_to(self, target: int) -> None:
        period = self.value(0x1006) / 1e6 or 1.0
        speed, most = (target - self.demand) / period, self.value(0x6080)
        if not self.value(0x607D, 1) <= target <= self.value(0x607D, 2):
            self.fail(OUT_OF_RANGE)
        elif most and abs(speed) > most:
            self.fail(TOO_FAST)
        else:
            self.demand, self.speed = float(target), speed

    def _ramp(self, dt_s: float) -> None:
        change = (self.value(0x6085) or math.inf) * dt_s
        self.speed -= math.copysign(min(change, abs(self.speed)), self.speed)
        self.demand += self.speed * dt_s
        if self.speed == 0.0:
            if self.state is Drive.FAULT_REACTION_ACTIVE:
                self.state = Drive.FAULT
            elif self.value(0x605A) != STAY_IN_QUICK_STOP:
                self.state = Drive.SWITCH_ON_DISABLED

    def _supervise(self, now: float) -> None:
        deadline, beat_s = self.value(0x1400, 5) / 1e3, (self.value(0x1016, 1) & 0xFFFF) / 1e3
        period = self.value(0x1006) / 1e6
        if now - self._synced_s > 1.5 * period:
            self.speed = 0.0  # nothing to interpolate to
        if deadline and period and now - self._synced_s > deadline:
            self._lose_master(SYNC_LOST)
        elif deadline and now - self._told_s > deadline:
            self._lose_master(TARGET_LATE)
        elif beat_s and self._master_s > -math.inf and now - self._master_s > beat_s:
            self._lose_master(HEARTBEAT_LOST)
        window = self.value(0x6065)
        if not window or abs(self.demand - self.actual) <= window:
            self._erring_since_s = now
        elif now - self._erring_since_s > self.value(0x6066) / 1e3:
            self.fail(FOLLOWING_ERROR)

    def _lose_master(self, code: int = 0) -> None:
        if code:
            self._say(code)
        if self.state is Drive.OPERATION_ENABLED and self.value(0x6007) == QUICK_STOP:
            self.state = Drive.QUICK_STOP_ACTIVE

    def _obey(self, control: int) -> None:
        is_reset = control & 0x80 and not self._control & 0x80
        self._control = control
        state = self.state
        if state is Drive.FAULT:
            if is_reset:
                self._say(0)
                self.entries[0x603F, 0].value, self.state = 0, Drive.SWITCH_ON_DISABLED
        elif state is not Drive.FAULT_REACTION_ACTIVE:
            self.state = self._next(state, control)
            if self.state is Drive.OPERATION_ENABLED is not state:
                self.demand, self.speed = float(self.actual), 0.0

    def _next(self, state: Drive, control: int) -> Drive:
        off = Drive.SWITCH_ON_DISABLED
        is_moving = state in {Drive.OPERATION_ENABLED, Drive.QUICK_STOP_ACTIVE}
        if control & 0x06 != 0x06:
            return Drive.QUICK_STOP_ACTIVE if control & 0x02 and is_moving else off
        if state is Drive.QUICK_STOP_ACTIVE:
            return state
        ready, on, enabled = Drive.READY_TO_SWITCH_ON, Drive.SWITCHED_ON, Drive.OPERATION_ENABLED
        low = control & 0x0F
        if low == 0x06:
            return ready
        if low == 0x07 and state in {ready, enabled}:
            return on
        is_able = low == 0x0F and state is on and self.value(0x6060) == CYCLIC_SYNCHRONOUS_POSITION
        return enabled if is_able else state

    def hear_sdo(self, data: bytes) -> None:
        """A question or an order to the dictionary."""
        if len(data) != 8 or self.nmt in {0, STOPPED}:
            return
        command, index, sub, payload = _SDO.unpack(data)
        if command == 0x80:
            return  # the client gives up
        self.entries[0x6041, 0].value = self.state.value[1] | 0x0200
        self.entries[0x6064, 0].value = self.actual
        self.entries[0x6061, 0].value = self.value(0x6060)
        entry = self.entries.get((index, sub))
        if entry is None:
            is_known = any(index == key[0] for key in self.entries)
            answer = _abort(index, sub, NO_SUB if is_known else NO_OBJECT)
        elif command == 0x40:
            value = entry.value.to_bytes(entry.size, "little", signed=entry.is_signed)
            answer = _SDO.pack(_READ_COMMANDS[entry.size], index, sub, value)
        elif command not in _WRITE_SIZES:
            answer = _abort(index, sub, NO_COMMAND)
        elif entry.is_read_only:
            answer = _abort(index, sub, READ_ONLY)
        elif _WRITE_SIZES[command] != entry.size:
            answer = _abort(index, sub, WRONG_SIZE)
        else:
            if (index, sub) not in self.deaf:
                value = payload[: entry.size]
                entry.value = int.from_bytes(value, "little", signed=entry.is_signed)
            answer = _SDO.pack(0x60, index, sub, b"")
        self._outbox.append((SDO_ANSWER_ID + self.node_id, answer))


def _abort(index: int, sub: int, code: int) -> bytes:
    return _SDO.pack(0x80, index, sub, struct.pack("<I", code))
