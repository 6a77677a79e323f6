"""How much of a bus a configuration uses, at worst-case bit stuffing.

Classic CAN, 11-bit identifier, n bytes: 44 + 8 n bits of frame, 3 of pause, and a stuff bit for
every 4 of the 34 + 8 n bits that are stuffed, after the first. CAN FD with bit-rate switch: up to
BRS and from the end of the checksum on at the nominal rate, what lies between at the data rate.
"""

from __future__ import annotations

from dataclasses import dataclass

from viskill_deploy.core.errors import DriverError

LIMIT = 0.70
"""What is left is for SDO, emergency objects, and frames that are sent again after an error."""

PDO_BYTES = 6
"""Two bytes of controlword or statusword, four of position."""
INPUT_BYTES = 4


@dataclass(frozen=True, slots=True)
class BusTraffic:
    """What goes over one bus.

    Attributes:
        axes: drives; each gets and sends one process data object in every period.
        heartbeats_s: mean time between two heartbeats of anybody.
        inputs_s: time between two words of the input node; None without one.
        data_bitrate_bit_s: of CAN FD's fast part; None for classic CAN.
    """

    axes: int
    period_s: float
    heartbeats_s: float
    inputs_s: float | None
    bitrate_bit_s: int
    data_bitrate_bit_s: int | None

    @property
    def load(self) -> float:
        """Part of the time in which the bus is taken."""
        pdo_s = self.frame_s(PDO_BYTES)
        cyclic = 2 * self.axes * pdo_s + classic_bits(0) / self.bitrate_bit_s
        rest = classic_bits(1) / self.bitrate_bit_s / self.heartbeats_s
        if self.inputs_s is not None:
            rest += classic_bits(INPUT_BYTES) / self.bitrate_bit_s / self.inputs_s
        return cyclic / self.period_s + rest

    def frame_s(self, size: int) -> float:
        """How long a process data object of `size` bytes takes, s."""
        if self.data_bitrate_bit_s is None:
            return classic_bits(size) / self.bitrate_bit_s
        slow, fast = fd_bits(size)
        return slow / self.bitrate_bit_s + fast / self.data_bitrate_bit_s


def classic_bits(size: int) -> int:
    """Most bits that a classic frame of `size` bytes takes, pause included."""
    return 47 + 8 * size + (34 + 8 * size - 1) // 4


def fd_bits(size: int) -> tuple[int, int]:
    """Most bits of an FD frame of up to 16 bytes at the nominal and at the data rate."""
    head, tail = 17, 13  # start to BRS; end of checksum, acknowledgement, end of frame, pause
    body = 5 + 8 * size
    stuffed = (head + body - 1) // 4
    checksum = 4 + 17 + 6  # stuff count, CRC-17, fixed stuff bits
    slow_stuff = (head - 1) // 4
    return head + slow_stuff + tail, body + stuffed - slow_stuff + checksum


def check_load(arm: str, traffic: BusTraffic) -> float:
    """The load of a bus, if it is bearable.

    Raises:
        DriverError: it is more than `LIMIT`; names the load.
    """
    load = traffic.load
    if load > LIMIT:
        kind = "classic CAN" if traffic.data_bitrate_bit_s is None else "CAN FD"
        raise DriverError(
            f"bus of {arm}: {traffic.axes} axes at {1 / traffic.period_s:.0f} Hz load {kind} with "
            f"{traffic.bitrate_bit_s / 1e6:g} Mbit/s by {load:.1%}, more than {LIMIT:.0%}; lower "
            "cycle_hz, or set data_bitrate_bit_s and use CAN FD"
        )
    return load
