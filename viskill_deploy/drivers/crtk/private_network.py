"""A network for one simulated robot: on this machine only, and nobody else's."""

from __future__ import annotations

import socket
from typing import Final

from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.crtk.opening import LOOPBACK, Network

FIRST_DOMAIN: Final = 40
LAST_DOMAIN: Final = 100
"""Above it, the ports of a domain are those that the system gives to anyone."""


class PrivateNetwork:
    """A ROS 2 domain on the loopback interface that no other simulated robot of this machine has.

    Attributes:
        network: where it is.

    Raises:
        DriverError: all such domains are taken.
    """

    def __init__(self) -> None:
        for domain in range(FIRST_DOMAIN, LAST_DOMAIN + 1):
            lock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            try:
                lock.bind(f"\0viskill-domain-{domain}")  # the kernel lets go of it with the process
            except OSError:
                lock.close()
                continue
            self.network, self._lock = Network(domain, LOOPBACK), lock
            return
        raise DriverError("every domain for simulated robots is taken; end other simulations")

    def close(self) -> None:
        """Lets others have it."""
        self._lock.close()
