"""One bus of python-can, without threads: frames out, frames in, and how the bus is."""

from __future__ import annotations

import contextlib
import select
from typing import Any

from viskill_deploy.core.errors import DriverError, MissingExtraError

try:
    import can
except ImportError as error:
    raise MissingExtraError("can", "the CAN driver") from error

from viskill_deploy.drivers.can.multicast import LoopbackMulticast

MOST_AT_ONCE = 2000
"""Frames that are read in one go: more than a second's worth, so that a babbler starves nobody."""

BUS_OFF, CONTROLLER = 0x40, 0x04
PASSIVE = 0x30
"""Bits of socketcan's error frames."""

Frame = tuple[int, bytes]
"""Identifier and data."""


class _Message(can.Message):
    """A frame that the `virtual` bus copies at a tenth of the cost."""

    def __deepcopy__(self, memo: dict[int, Any] | None) -> can.Message:
        del memo  # nothing in a frame refers to anything else
        return can.Message.__copy__(self)


class CanLine:
    """A bus.

    Args:
        owner: whose bus it is, for messages.
        interface: python-can's name of it.
        channel: which one.
        is_fd: cyclic frames are CAN FD with bit-rate switch.

    Attributes:
        foreign: frames that nobody on such a bus sends: extended, remote, or no frames at all.
        trouble: what the controller says of the bus; "" when all is well.

    Raises:
        DriverError: there is no such bus.
    """

    def __init__(self, owner: str, interface: str, channel: str, is_fd: bool = False) -> None:
        self.owner, self.foreign, self.trouble = owner, 0, ""
        self._is_fd = is_fd
        try:
            self._bus = _opened(interface, channel, is_fd)
        except (can.CanError, OSError, ValueError) as error:
            raise DriverError(
                f"bus of {owner}: {interface} {channel} cannot be opened ({error}); look at "
                "interface and channel in the CAN file, and whether the network is up"
            ) from error
        self._descriptor = -1
        with contextlib.suppress(NotImplementedError):
            self._descriptor = self._bus.fileno()

    def fileno(self) -> int:
        """For selectors; -1 where there is none."""
        return self._descriptor

    def send(self, identifier: int, data: bytes, cyclic: bool = False) -> None:
        """Sends one frame.

        Raises:
            DriverError: the bus does not take it.
        """
        is_fast = cyclic and self._is_fd
        message = _Message(
            arbitration_id=identifier,
            data=data,
            is_extended_id=False,
            is_fd=is_fast,
            bitrate_switch=is_fast,
            check=False,
        )
        try:
            self._bus.send(message)
        except (can.CanError, OSError) as error:
            raise DriverError(
                f"bus of {self.owner} takes no frame ({error}); look at its plugs and terminators"
            ) from error

    def drain(self) -> list[Frame]:
        """Every frame that has arrived, oldest first."""
        frames: list[Frame] = []
        for _ in range(MOST_AT_ONCE):
            if self._descriptor >= 0 and not select.select([self._descriptor], [], [], 0.0)[0]:
                break
            try:
                message = self._bus.recv(0.0)
            except (can.CanError, ValueError, TypeError, KeyError):
                self.foreign += 1  # no frame
                continue
            if message is None:
                if self._descriptor < 0:
                    break
                continue  # one of our own
            if message.is_error_frame:
                self._note(message.arbitration_id, bytes(message.data))
            elif message.is_extended_id or message.is_remote_frame or self._is_odd(message):
                self.foreign += 1
            else:
                frames.append((message.arbitration_id, bytes(message.data)))
        self._look()
        return frames

    def close(self) -> None:
        """Lets go of the bus."""
        self._bus.shutdown()

    def _is_odd(self, message: can.Message) -> bool:
        return message.is_fd and not self._is_fd

    def _note(self, identifier: int, data: bytes) -> None:
        if identifier & BUS_OFF:
            self._say("is off: its controller gave up after too many errors")
        elif identifier & CONTROLLER and len(data) > 1 and data[1] & PASSIVE:
            self._say("is error-passive: frames arrive spoilt")

    def _look(self) -> None:
        if self._bus.state is can.BusState.ERROR:
            self._say("is off: its controller gave up after too many errors")
        elif self._bus.state is can.BusState.PASSIVE:
            self._say("is error-passive: frames arrive spoilt")

    def _say(self, what: str) -> None:
        if not self.trouble:
            self.trouble = f"bus of {self.owner} {what}; look at its plugs and terminators"


def _opened(interface: str, channel: str, is_fd: bool) -> can.BusABC:
    if interface == "udp_multicast":
        return LoopbackMulticast(channel)
    options: dict[str, Any] = {"fd": is_fd} if interface == "socketcan" else {}
    return can.Bus(interface=interface, channel=channel, **options)
