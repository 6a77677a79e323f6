"""A person at the terminal and at the arms: the tips are brought to points, we only listen."""

from __future__ import annotations

import enum
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from viskill_deploy.calibrate.landmarks import (
    FEWEST_TOUCHES,
    Landmark,
    board_landmarks,
    choose_landmarks,
)
from viskill_deploy.calibrate.resting import Arms
from viskill_deploy.calibrate.simulated_hand import HandOptions, SimulatedHand
from viskill_deploy.calibrate.touching import Hand, touch
from viskill_deploy.calibrate.truths import HiddenRobot
from viskill_deploy.cli.terminal import Terminal
from viskill_deploy.core.calibration_files import insist_real, insist_simulated
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import FloatArray
from viskill_deploy.drivers.crtk.listening import listen
from viskill_deploy.drivers.crtk.opening import Network
from viskill_deploy.runtime.operator import Operator
from viskill_deploy.sim.world import WorldOptions

TOUCH_NOISE_M = HandOptions().noise_m
TOUCHES = 12
"""Points an arm, unless asked for otherwise."""


class TouchedRobot(enum.StrEnum):
    """Whose arms are touched with."""

    LOOPBACK = "loopback"
    CRTK = "crtk"


Driver = Annotated[
    TouchedRobot,
    typer.Option(help="Arms to listen to; loopback: simulated ones, moved by a simulated person."),
]


@dataclass(frozen=True)
class TouchedBy:
    """Which arms, and who moves them.

    Attributes:
        robot: simulated arms and person, or a dVRK and a person at this terminal.
        transport: what carries CRTK.
        network: where the robot is.
        hidden: what the simulated arms and board really are; None for as their files say.
        noise_m: how well the simulated person touches, standard deviation of a coordinate.
        slips: part of their touches that are somewhere else.
        seed: of these.
    """

    robot: TouchedRobot = TouchedRobot.LOOPBACK
    transport: str = "auto"
    network: Network = field(default_factory=Network)
    hidden: HiddenRobot | None = None
    noise_m: float = TOUCH_NOISE_M
    slips: float = 0.0
    seed: int = 0


class Person:
    """Somebody at a terminal; it is a `Hand`.

    Args:
        operator: the terminal.
    """

    def __init__(self, operator: Operator) -> None:
        self._operator = operator

    def tell(self, note: str) -> None:
        """Prints it."""
        self._operator.tell(note)

    def bring(self, arm: int, landmark: Landmark, words: str) -> str:
        """Asks, and waits for a line."""
        del arm, landmark
        self._operator.ask(words)
        while (said := self._operator.answer()) is None:
            pass
        return said


@contextmanager
def touched_by(
    cell: CellDescription, who: TouchedBy, things: Mapping[str, FloatArray] | None = None
) -> Iterator[tuple[Arms, Hand]]:
    """The arms, connected, and who moves them. Nothing is ever sent to an arm.

    Args:
        cell: the cell as the program believes it to be; simulated arms are as its files say.
        who: which arms.
        things: where simulated things are, board's frame, (4, 4) by name.

    Raises:
        DriverError: the arms are not heard.
        CalibrationError: the cell's arms are real, and simulated ones would stand in for them; or
            they are simulated, and would stand in for a robot's.
        BadParameter: a truth can only be hidden in simulated arms.
    """
    if who.robot is TouchedRobot.LOOPBACK:
        insist_simulated(cell)
        world = WorldOptions()
        if who.hidden is not None:
            world = who.hidden.world(cell, world)
        options = HandOptions(who.noise_m, who.slips)
        hand = SimulatedHand(cell.filed or cell, world, options, who.seed, things)
        yield hand, hand
        return
    if who.hidden is not None:
        raise typer.BadParameter("--truth hides errors in simulated arms; leave --driver out")
    insist_real(cell)
    driver = listen(cell, who.transport, who.network)
    try:
        yield driver, Person(Terminal(Console(stderr=True), patience_s=0.05))
    finally:
        driver.close()


def collect_by_touch(
    cell: CellDescription, folder: Path, points: int, who: TouchedBy
) -> dict[str, Any]:
    """Has every arm touch its points; what was touched, for people and programs.

    Raises:
        CalibrationError: the cell has too few points in reach, or the folder holds something else.
        Interrupted: they stopped; what was touched is kept.
    """
    if points < FEWEST_TOUCHES:
        raise typer.BadParameter(f"--points: touch at least {FEWEST_TOUCHES} an arm")
    marks = board_landmarks(cell)
    wanted = [choose_landmarks(cell, index, marks, points) for index in range(len(cell.arms))]
    with touched_by(cell, who) as (arms, hand):
        books = touch(cell, arms, hand, wanted, folder)
    return {
        "files": {name: str(book.path) for name, book in books.items()},
        "touched": {name: list(book.touches) for name, book in books.items()},
    }
