"""Keeps the sockets of a DDS domain to the loopback device.

CycloneDDS announces itself on the interface that it is told, but listens on all of them. A
simulated robot must not be reached from outside, so the kernel gives these sockets nothing else.
"""

from __future__ import annotations

import ctypes
import os
import socket
from contextlib import suppress
from pathlib import Path

from viskill_deploy.core.errors import DriverError

RTPS_PORTS, PORTS_PER_DOMAIN = 7400, 250
DEVICE = b"lo"


def confine(domain: int) -> int:
    """Ties this process's sockets of a DDS domain to the loopback device.

    Args:
        domain: the domain's number.

    Returns:
        How many there are.

    Raises:
        DriverError: none was found, or the system refuses.
    """
    first = RTPS_PORTS + PORTS_PER_DOMAIN * domain
    names = _bound_to(range(first, first + PORTS_PER_DOMAIN))
    handles = [handle for handle, name in _handles() if name in names]
    for handle in handles:
        _tie(handle)
    if not handles:
        raise DriverError(f"DDS domain {domain} has no socket that could be kept to this machine")
    return len(handles)


def _bound_to(ports: range) -> set[str]:
    """The UDP sockets of this machine at some ports, as the links to them are named."""
    found = set()
    for table in ("udp", "udp6"):
        with suppress(FileNotFoundError):  # no IPv6 here
            for line in Path(f"/proc/self/net/{table}").read_text().splitlines()[1:]:
                columns = line.split()
                if int(columns[1].rsplit(":", 1)[1], 16) in ports:
                    found.add(f"socket:[{columns[9]}]")
    return found


def _handles() -> list[tuple[int, str]]:
    """This process's open files, and what they are."""
    found = []
    for link in tuple(Path("/proc/self/fd").iterdir()):
        with suppress(FileNotFoundError):  # closed meanwhile
            found.append((int(link.name), str(link.readlink())))
    return found


def _tie(handle: int) -> None:
    """Asks the C library: a Python socket for the handle could change whether it blocks."""
    library = ctypes.CDLL(None, use_errno=True)
    level, option = socket.SOL_SOCKET, socket.SO_BINDTODEVICE
    if library.setsockopt(handle, level, option, DEVICE, len(DEVICE)) != 0:
        why = os.strerror(ctypes.get_errno())
        raise DriverError(
            f"the system does not let DDS be kept to this machine ({why}; it takes Linux 5.7); "
            "run in a network namespace of its own, or name no interface"
        )
