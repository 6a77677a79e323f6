"""A CAN bus between the processes of one machine: python-can's `udp_multicast`, but for loopback.

python-can's own bus listens on every network, gives a sender its own frames back, and takes the
frames of every group of its port, so that two buses are one. Here one socket is bound to one group
on the loopback interface alone, and another sends, whose address tells own frames apart. Datagrams
are python-can's. Nothing leaves the machine, no route is needed, and nothing outside is heard.
"""

from __future__ import annotations

import ipaddress
import socket

import can
from can.interfaces.udp_multicast.utils import pack_message, unpack_message

PORT = 43113
"""python-can's."""

HERE = "127.0.0.1"
MOST_BYTES = 4096
BUFFER_BYTES = 4 << 20
"""There is no back-pressure: what does not fit is lost. The kernel may grant less than this."""

IP_MULTICAST_ALL = 49
"""Linux: whether frames of groups that other sockets have joined arrive, too. Not in `socket`."""


class LoopbackMulticast(can.BusABC):
    """A bus that processes of this machine share.

    Args:
        channel: the group, an IPv4 multicast address.

    Raises:
        OSError, ValueError: there is no such group, or no loopback interface.
    """

    def __init__(self, channel: str) -> None:
        self._destination = (_group(channel), PORT)
        self._ears = _listening(channel)
        self._mouth = _speaking()
        self._me = self._mouth.getsockname()
        super().__init__(channel)

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Sends a frame to everybody on the bus but oneself."""
        del timeout  # the loopback never makes one wait
        try:
            self._mouth.sendto(pack_message(msg), self._destination)
        except OSError as error:
            raise can.CanOperationError(f"the group does not take it: {error}") from error

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        self._ears.settimeout(timeout)
        while True:
            try:
                data, sender = self._ears.recvfrom(MOST_BYTES)
            except (BlockingIOError, TimeoutError):
                return None, False
            if sender != self._me:
                return _message(data), False

    def fileno(self) -> int:
        """For selectors."""
        return self._ears.fileno()

    def shutdown(self) -> None:
        """Leaves the group."""
        super().shutdown()
        self._ears.close()
        self._mouth.close()


def _message(data: bytes) -> can.Message:
    try:
        return unpack_message(data, check=True)
    except Exception as error:  # a stranger's bytes may go wrong in any way
        raise can.CanOperationError(f"a datagram is no frame: {error}") from error


def _group(channel: str) -> str:
    if not ipaddress.IPv4Address(channel).is_multicast:
        raise ValueError(f"{channel} is no multicast address; take one like 239.74.163.2")
    return channel


def _listening(channel: str) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        made.setsockopt(socket.IPPROTO_IP, IP_MULTICAST_ALL, 0)
        member = socket.inet_aton(channel) + socket.inet_aton(HERE)
        made.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        made.bind((channel, PORT))
    except OSError:
        made.close()
        raise
    return made


def _speaking() -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(HERE))
    made.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)  # not farther than this machine
    made.bind((HERE, 0))
    return made
