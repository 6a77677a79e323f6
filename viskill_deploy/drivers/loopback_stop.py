"""A second handle to the served loopback: what its watchdog and any stop button hold on to.

Apart from the driver, so that a watchdog starts without the simulator.
"""

from __future__ import annotations

import socket
from pathlib import Path

from viskill_deploy.core.clock import Clock, MonotonicClock
from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.loopback_wire import LineSocket, Message

START_TIMEOUT_S = 20.0


class StopHandle:
    """A second connection to a served loopback: it may hold and disable, and look."""

    def __init__(self, path: Path) -> None:
        self._line = LineSocket(connected(path, MonotonicClock()))

    def hold(self) -> None:
        """Every arm stays where it is, and takes no setpoint until it is enabled again."""
        self._line.send({"do": "hold"})

    def disable(self) -> None:
        """Takes power from every arm."""
        self._line.send({"do": "disable"})

    def check(self) -> None:
        """Raises DriverError when the loopback is gone."""
        self._line.receive()

    def send(self, message: Message) -> None:
        """Sends any request; the server refuses all but a few."""
        self._line.send(message)

    def answers(self) -> list[Message]:
        """What the server has said to this handle."""
        return self._line.receive()

    def ask(self) -> None:
        """Asks for the state of the cell and when a handle like this first stopped it."""
        self._line.send({"do": "state"})

    def close(self) -> None:
        """Lets go."""
        self._line.close()


def connected(path: Path, clock: Clock) -> socket.socket:
    """A socket connected to the server at `path`, which may still be starting.

    Raises:
        DriverError: there is none.
    """
    deadline = clock.now() + START_TIMEOUT_S
    while True:
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            connection.connect(str(path))
        except OSError as error:
            connection.close()
            if clock.now() > deadline:
                raise DriverError(f"no loopback at {path} ({error}); start it first") from error
            clock.sleep_until(clock.now() + 0.02)
        else:
            return connection
