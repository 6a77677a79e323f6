"""Simulated drives for anybody's master, in real time, with an operator who types."""

from __future__ import annotations

import os
import selectors

from viskill_deploy.core.clock import Clock
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.can.config import CanFile
from viskill_deploy.drivers.can.simulated_cell import DriveCell
from viskill_deploy.drivers.crtk.serving import set_up
from viskill_deploy.drivers.loopback_cell import LoopbackCell
from viskill_deploy.sim.world import WorldOptions

ORDERS = "consent, no consent, estop, no estop, break PSM1/yaw stuck (or slip), mend"
"""What the operator may type."""


def drive_cell(
    cell: CellDescription, file: CanFile, seed: int = 0, options: WorldOptions | None = None
) -> DriveCell:
    """Drives on the buses of a file, in front of a simulated cell.

    Args:
        cell: the cell.
        file: its drives.
        seed: of where things lie.
        options: what is not perfect, with the file's period.

    Raises:
        DriverError: the file's buses end in this process, or cannot be opened.
    """
    if file.interface == "virtual":
        raise DriverError(
            "virtual buses end in their process, nobody could come; choose udp_multicast or "
            "socketcan with --interface"
        )
    world = set_up(cell, seed, options or WorldOptions(period_s=1.0 / file.cycle_hz))
    return DriveCell(LoopbackCell(world), file)


def obey(front: DriveCell, order: str) -> None:
    """Does what the operator has typed.

    Raises:
        DriverError: there is no such order; lists those that there are.
    """
    match order.split():
        case ["consent"]:
            front.cell.say(consent=True)
        case ["no", "consent"]:
            front.cell.say(consent=False)
        case ["estop"]:
            front.cell.say(estop=True)
        case ["no", "estop"]:
            front.cell.say(estop=False)
        case ["break", joint, kind]:
            front.cell.break_drive(joint, kind)
        case ["mend"]:
            front.cell.break_drive("", "mended")
        case _:
            raise DriverError(f"no order {order!r}; type one of: {ORDERS}")


class DriveServer:
    """Steps drives and cell against the clock, and hears masters and operator between two steps.

    Args:
        front: the drives.
        clock: real time.
        orders: descriptor of what the operator types; it may end.
    """

    def __init__(self, front: DriveCell, clock: Clock, orders: int) -> None:
        self._front, self._clock, self._orders, self._typed = front, clock, orders, b""
        self._waiting = selectors.SelectSelector()  # also takes files and /dev/null
        for line in front.lines:
            self._waiting.register(line, selectors.EVENT_READ)
        self._waiting.register(orders, selectors.EVENT_READ)

    def run(self) -> None:
        """Serves until it is interrupted."""
        period, deadline = self._front.cell.world.options.period_s, self._clock.now()
        while True:
            deadline = max(deadline + period, self._clock.now())  # late once, not for ever
            self._serve_until(deadline)
            self._front.advance(self._clock.now())

    def _serve_until(self, deadline: float) -> None:
        while True:
            for key, _ in self._waiting.select(max(deadline - self._clock.now(), 0.0)):
                if key.fileobj == self._orders:
                    self._listen()
                else:
                    self._front.poll(self._clock.now())
            if self._clock.now() >= deadline:
                return

    def _listen(self) -> None:
        typed = os.read(self._orders, 4096)
        if not typed:
            self._waiting.unregister(self._orders)
        *lines, self._typed = (self._typed + typed).split(b"\n")
        for line in filter(None, map(bytes.strip, lines)):
            try:
                obey(self._front, line.decode(errors="replace"))
                print("done", flush=True)
            except DriverError as error:
                print(error, flush=True)
