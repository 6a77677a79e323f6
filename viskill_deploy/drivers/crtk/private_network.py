"""A network for one simulated robot: on this machine only, and nobody else's.

A real robot may speak where this machine usually listens. Its arms have the names of the simulated
ones, and would do what those are told.
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
from typing import Final

from viskill_deploy.core.clock import MonotonicClock
from viskill_deploy.core.errors import DriverError, MissingRosError
from viskill_deploy.drivers.crtk.opening import LOOPBACK, Network
from viskill_deploy.drivers.crtk.readiness import ADVICE

FIRST_DOMAIN: Final = 40
LAST_DOMAIN: Final = 100
"""Above it, the ports of a domain are those that the system gives to anyone."""

MASTER_S: Final = 20.0
LOOK_S: Final = 0.05


class PrivateNetwork:
    """A ROS 2 domain, or a ROS 1 master, that no other simulated robot of this machine has.

    A master is known to this process and its children by their environment, as ROS 1 has it.

    Args:
        transport: what goes over it.

    Attributes:
        network: where it is.

    Raises:
        DriverError: all such domains are taken, or the master does not come up.
        MissingRosError: there is no master to start.
    """

    def __init__(self, transport: str) -> None:
        self._lock, domain = _locked()
        self.network = Network(domain, LOOPBACK)
        self._master = _master() if transport == "ros1" else None

    def close(self) -> None:
        """Lets others have it."""
        if self._master is not None:
            self._master.terminate()
            self._master.wait()
            self._master = None
        self._lock.close()


def _locked() -> tuple[socket.socket, int]:
    """A domain, and what keeps it; the kernel lets go of it with the process."""
    for domain in range(FIRST_DOMAIN, LAST_DOMAIN + 1):
        lock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            lock.bind(f"\0viskill-domain-{domain}")
        except OSError:
            lock.close()
            continue
        return lock, domain
    raise DriverError("every domain for simulated robots is taken; end other simulations")


def _master() -> subprocess.Popen[bytes]:
    """A master of ROS 1 on a port that is free."""
    program = shutil.which("rosmaster")
    if program is None:
        raise MissingRosError(f"there is no rosmaster; {ADVICE['ros1']}")
    with socket.socket() as free:
        free.bind((LOOPBACK, 0))
        port = free.getsockname()[1]
    os.environ["ROS_MASTER_URI"] = f"http://{LOOPBACK}:{port}"
    os.environ["ROS_IP"] = os.environ["ROS_HOSTNAME"] = LOOPBACK
    command = [program, "--core", "-p", str(port)]
    quiet = subprocess.DEVNULL
    master = subprocess.Popen(command, stdout=quiet, stderr=quiet, start_new_session=True)
    clock = MonotonicClock()
    deadline = clock.now() + MASTER_S
    while not _listens(port):
        if master.poll() is not None or clock.now() > deadline:
            master.kill()
            raise DriverError(f"{program} does not come up; try it by hand: {' '.join(command)}")
        clock.sleep_until(clock.now() + LOOK_S)
    return master


def _listens(port: int) -> bool:
    with socket.socket() as one:
        return one.connect_ex((LOOPBACK, port)) == 0
