"""What an axis is told and says in every cycle, as bytes. Other protocols bring another codec."""

from __future__ import annotations

import enum
import struct
from dataclasses import dataclass
from typing import Protocol

SYNC_ID = 0x080
NMT_ID = 0x000
EMCY_ID, TPDO_ID, RPDO_ID = 0x080, 0x180, 0x200
SDO_ANSWER_ID, SDO_REQUEST_ID, HEARTBEAT_ID = 0x580, 0x600, 0x700


class Drive(enum.Enum):
    """States of a CiA 402 drive, with mask and value of the statusword."""

    NOT_READY = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY_TO_SWITCH_ON = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    OPERATION_ENABLED = (0x6F, 0x27)
    QUICK_STOP_ACTIVE = (0x6F, 0x07)
    FAULT_REACTION_ACTIVE = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)


class Control(enum.IntEnum):
    """Controlwords."""

    DISABLE_VOLTAGE = 0x00
    QUICK_STOP = 0x02
    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    ENABLE_OPERATION = 0x0F
    FAULT_RESET = 0x80


@dataclass(frozen=True, slots=True)
class Reading:
    """What a drive says in one cycle.

    Attributes:
        state: None for a statusword of no state that there is.
        counts: measured position.
    """

    state: Drive | None
    counts: int


class AxisCodec(Protocol):
    """How one axis is told a target, and understood."""

    command_id: int
    feedback_id: int

    def command(self, control: int, counts: int) -> bytes:
        """The bytes that tell the axis its controlword and target."""
        ...

    def reading(self, data: bytes) -> Reading | None:
        """What the axis says; None when these bytes are none of its own."""
        ...


_STATES = {
    word: state
    for word in range(0x80)
    for state in Drive
    if word & state.value[0] == state.value[1]
}
_PDO = struct.Struct("<Hi")


def drive_state(statusword: int) -> Drive | None:
    """The state in a statusword."""
    return _STATES.get(statusword & 0x7F)


class Cia402Codec:
    """Cyclic synchronous position over CANopen: controlword and target, statusword and position."""

    def __init__(self, node_id: int) -> None:
        self.command_id, self.feedback_id = RPDO_ID + node_id, TPDO_ID + node_id

    def command(self, control: int, counts: int) -> bytes:
        """RPDO 1: 0x6040 and 0x607A."""
        return _PDO.pack(control, counts)

    def reading(self, data: bytes) -> Reading | None:
        """TPDO 1: 0x6041 and 0x6064."""
        if len(data) != _PDO.size:
            return None
        statusword, counts = _PDO.unpack(data)
        return Reading(drive_state(statusword), counts)
