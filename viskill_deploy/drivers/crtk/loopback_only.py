"""Keeps the sockets of a DDS domain to the loopback device.

CycloneDDS announces itself on the interface that it is told, but listens on all of them. A
simulated robot must not be reached from outside, so the kernel gives these sockets nothing else.
"""

from __future__ import annotations

import os
import socket
from contextlib import suppress
from pathlib import Path

from viskill_deploy.core.errors import DriverError

FAMILIES = (socket.AF_INET, socket.AF_INET6)
RTPS_PORTS, PORTS_PER_DOMAIN = 7400, 250


def confine(domain: int) -> int:
    """Ties this process's sockets of a DDS domain to the loopback device.

    Args:
        domain: the domain's number.

    Returns:
        How many there are.

    Raises:
        DriverError: none was found, or the system refuses.
    """
    first, count = RTPS_PORTS + PORTS_PER_DOMAIN * domain, 0
    for handle in _sockets():
        with socket.socket(fileno=os.dup(handle)) as one:
            is_udp = one.family in FAMILIES and one.type == socket.SOCK_DGRAM
            if is_udp and one.getsockname()[1] in range(first, first + PORTS_PER_DOMAIN):
                _tie(one)
                count += 1
    if not count:
        raise DriverError(f"DDS domain {domain} has no socket that could be kept to this machine")
    return count


def _sockets() -> list[int]:
    """This process's open sockets."""
    found = []
    for handle in tuple(Path("/proc/self/fd").iterdir()):
        with suppress(FileNotFoundError):  # closed meanwhile
            if str(handle.readlink()).startswith("socket:"):
                found.append(int(handle.name))
    return found


def _tie(one: socket.socket) -> None:
    try:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo")
    except OSError as error:
        raise DriverError(
            "the system does not let DDS be kept to this machine (SO_BINDTODEVICE, Linux 5.7); "
            "run in a network namespace of its own, or name no interface"
        ) from error
