"""The objects of a drive that are written at start-up, and read back. All are off by default.

Positions are in counts; see docs/can.md for the table.
"""

from __future__ import annotations

from dataclasses import dataclass

from viskill_deploy.drivers.can.codec import RPDO_ID, TPDO_ID
from viskill_deploy.drivers.can.config import CanFile, LinearAxis, RotaryAxis

UNSIGNED, SIGNED = False, True
SYNCHRONOUS = 1
"""Transmission type: with every SYNC."""
OFF = 1 << 31
"""In a COB-ID: this object is not used."""

CYCLIC_SYNCHRONOUS_POSITION = 8
QUICK_STOP, STAY_IN_QUICK_STOP, RAMP_DOWN = 3, 6, 2
MOST_MS = 0xFFFF


@dataclass(frozen=True, slots=True)
class DriveObject:
    """One entry of a drive's dictionary and its value.

    Attributes:
        size: bytes.
        is_safety: the drive would not stop by itself, or not in time, without it.
    """

    index: int
    sub: int
    size: int
    is_signed: bool
    value: int
    name: str
    is_safety: bool = False

    @property
    def key(self) -> str:
        """As written in manuals, such as 0x1400:05."""
        return f"0x{self.index:04X}:{self.sub:02X}"

    @property
    def data(self) -> bytes:
        """The value as the drive reads it."""
        return self.value.to_bytes(self.size, "little", signed=self.is_signed)


def axis_objects(
    file: CanFile, axis: RotaryAxis | LinearAxis, period_s: float
) -> tuple[DriveObject, ...]:
    """What one drive is told at start-up, in this order; a later value of one entry is the last.

    Args:
        file: times and node ids.
        axis: the drive.
        period_s: control period; the SYNC's.
    """
    return (*_communication(file, axis.node_id, period_s), *_motion(axis, period_s))


def _ms(seconds: float) -> int:
    return max(1, min(round(seconds * 1e3), MOST_MS))


def _communication(file: CanFile, node: int, period_s: float) -> tuple[DriveObject, ...]:
    beat = _ms(file.heartbeat_s)
    consumer = file.master_node_id << 16 | 3 * beat
    o = DriveObject
    return (
        o(0x1400, 1, 4, UNSIGNED, OFF | RPDO_ID + node, "RPDO 1 COB-ID"),
        o(0x1800, 1, 4, UNSIGNED, OFF | TPDO_ID + node, "TPDO 1 COB-ID"),
        o(0x1017, 0, 2, UNSIGNED, beat, "heartbeat producer, ms", True),
        o(0x1016, 1, 4, UNSIGNED, consumer, "heartbeat consumer", True),
        o(0x1029, 1, 1, UNSIGNED, 1, "error behaviour: stay operational, and stop", True),
        o(0x1006, 0, 4, UNSIGNED, round(period_s * 1e6), "SYNC period, us", True),
        o(0x1007, 0, 4, UNSIGNED, round(file.sync_window_s * 1e6), "SYNC window, us", True),
        o(0x1400, 2, 1, UNSIGNED, SYNCHRONOUS, "RPDO 1 transmission type", True),
        o(0x1400, 5, 2, UNSIGNED, _ms(file.watchdog_s), "RPDO 1 deadline, ms", True),
        o(0x1600, 0, 1, UNSIGNED, 0, "RPDO 1 mapping, off"),
        o(0x1600, 1, 4, UNSIGNED, 0x6040_0010, "RPDO 1 mapping, controlword"),
        o(0x1600, 2, 4, UNSIGNED, 0x607A_0020, "RPDO 1 mapping, target position"),
        o(0x1600, 0, 1, UNSIGNED, 2, "RPDO 1 mapping, entries", True),
        o(0x1800, 2, 1, UNSIGNED, SYNCHRONOUS, "TPDO 1 transmission type", True),
        o(0x1A00, 0, 1, UNSIGNED, 0, "TPDO 1 mapping, off"),
        o(0x1A00, 1, 4, UNSIGNED, 0x6041_0010, "TPDO 1 mapping, statusword"),
        o(0x1A00, 2, 4, UNSIGNED, 0x6064_0020, "TPDO 1 mapping, position"),
        o(0x1A00, 0, 1, UNSIGNED, 2, "TPDO 1 mapping, entries", True),
        o(0x1400, 1, 4, UNSIGNED, RPDO_ID + node, "RPDO 1 COB-ID", True),
        o(0x1800, 1, 4, UNSIGNED, TPDO_ID + node, "TPDO 1 COB-ID", True),
    )


def _motion(axis: RotaryAxis | LinearAxis, period_s: float) -> tuple[DriveObject, ...]:
    ends = sorted(round(axis.sign * (x - axis.offset) * axis.scale) for x in axis.limits)
    following, ramp = round(axis.following * axis.scale), round(axis.quick_stop * axis.scale)
    tenths_ms = round(period_s * 1e4)
    o = DriveObject
    return (
        o(0x6060, 0, 1, SIGNED, CYCLIC_SYNCHRONOUS_POSITION, "mode of operation", True),
        o(0x60C2, 1, 1, UNSIGNED, tenths_ms, "interpolation period", True),
        o(0x60C2, 2, 1, SIGNED, -4, "interpolation period, power of ten", True),
        o(0x6007, 0, 2, SIGNED, QUICK_STOP, "abort connection: quick stop", True),
        o(0x605A, 0, 2, SIGNED, STAY_IN_QUICK_STOP, "quick stop: ramp, then hold", True),
        o(0x605E, 0, 2, SIGNED, RAMP_DOWN, "fault reaction: quick-stop ramp", True),
        o(0x6080, 0, 4, UNSIGNED, round(axis.speed * axis.scale), "most speed", True),
        o(0x6085, 0, 4, UNSIGNED, ramp, "quick-stop deceleration", True),
        o(0x6065, 0, 4, UNSIGNED, following, "following error window", True),
        o(0x6066, 0, 2, UNSIGNED, _ms(axis.following_s), "following error time, ms", True),
        o(0x607D, 1, 4, SIGNED, ends[0], "lower position limit", True),
        o(0x607D, 2, 4, SIGNED, ends[1], "upper position limit", True),
        o(0x6072, 0, 2, UNSIGNED, axis.torque_permille, "most torque, permille", True),
    )


def final(objects: tuple[DriveObject, ...]) -> tuple[DriveObject, ...]:
    """The value that each entry ends with."""
    return tuple({(entry.index, entry.sub): entry for entry in objects}.values())
