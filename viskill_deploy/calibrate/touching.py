"""Measuring by touch: a person brings tips to points whose place is known; we only listen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from viskill_deploy.calibrate.fit import FEWEST, misfits
from viskill_deploy.calibrate.landmarks import Landmark
from viskill_deploy.calibrate.resting import Arms, rested
from viskill_deploy.calibrate.touch_book import TouchBook
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import CalibrationError, Interrupted
from viskill_deploy.core.types import FloatArray

DOUBTFUL_M, DOUBTFUL = 0.002, 3.0
"""A touch is doubtful that is farther from where the others put it than this, and than this many
times their median."""

ROUNDS = 2
"""How often doubtful touches are asked for again."""

HELP = (
    "Enter: it is there · s: skip this point · the name of a point: touch that one again first · "
    "q: stop, and go on later"
)
KEEP = "Enter: touch it again · k: keep it as it is"


class Hand(Protocol):
    """Who brings the tips to points: a person at a terminal and an arm, or a simulated one."""

    def tell(self, note: str) -> None:
        """Says something."""
        ...

    def bring(self, arm: int, landmark: Landmark, words: str) -> str:
        """Asks for a tip at a point; returns what they say when it is there, "" for that it is."""
        ...


Off = Callable[[CellDescription, int, TouchBook], FloatArray]
"""How far every touch of an arm is from where the others put it, (n,) m."""


def off_of_arm(cell: CellDescription, index: int, book: TouchBook) -> FloatArray:
    """The same for points of the board, whatever the arm's base and joint 3 are."""
    if len(book.touches) < FEWEST:
        return np.zeros(len(book.touches))
    return misfits(cell.arms[index], book.measurements())


def touch(
    cell: CellDescription,
    arms: Arms,
    hand: Hand,
    wanted: Sequence[Sequence[Landmark]],
    folder: Path,
    off: Off = off_of_arm,
    what: str = "touch",
) -> dict[str, TouchBook]:
    """Has every arm touch its points, and writes each down; goes on where it was.

    Args:
        cell: the arms as their files have them.
        arms: reports their joints.
        hand: who brings them there.
        wanted: points of every arm.
        folder: gets `<arm>.csv`.
        off: how far each touch of an arm is from where the others put it, m.
        what: is measured; files of something else are not gone on with.

    Returns:
        The touches of every arm, by name.

    Raises:
        CalibrationError: the folder holds something else.
        Interrupted: they stopped; what was touched is kept.
        DriverError: an arm is lost; what was touched is kept.
    """
    folder.mkdir(parents=True, exist_ok=True)
    title = f"{what}: cell {cell.name}"
    books = {arm.name: TouchBook(folder / f"{arm.name}.csv", title, arm) for arm in cell.arms}
    hand.tell(HELP)
    for name, book in books.items():
        if book.touches:
            hand.tell(
                f"{name}: {len(book.touches)} points are kept that were touched before; touch one "
                "again by its name, or all of them in another folder"
            )
    for index, (book, marks) in enumerate(zip(books.values(), wanted, strict=True)):
        _Touching(cell, arms, hand, book, index, off).all_of(marks)
    return books


class _Touching:
    """One arm's points."""

    def __init__(
        self,
        cell: CellDescription,
        arms: Arms,
        hand: Hand,
        book: TouchBook,
        index: int,
        off: Off,
    ) -> None:
        self._cell, self._arm, self._arms = cell, cell.arms[index], arms
        self._hand, self._book, self._index, self._off = hand, book, index, off

    def all_of(self, marks: Sequence[Landmark]) -> None:
        """All points that were not touched yet, and then the doubtful ones again."""
        self._each([mark for mark in marks if mark.name not in self._book.touches], marks)
        for _ in range(ROUNDS):
            again = self._again([mark for mark in marks if mark.name in self._book.touches])
            if not again:
                return
            self._each(again, marks)

    def _each(self, todo: list[Landmark], marks: Sequence[Landmark]) -> None:
        names = {mark.name: mark for mark in marks}
        while todo:
            mark = todo[0]
            words = f"{self._arm.name}: touch {mark}; {len(todo)} to go"
            match self._hand.bring(self._index, mark, words).strip().lower():
                case "":
                    if self._is_taken(mark):
                        todo.pop(0)
                case "s":
                    todo.pop(0)
                case "q":
                    raise Interrupted(f"stopped; start again to go on: {self._book.path} is kept")
                case said if said in names:
                    todo.insert(0, names[said])
                case said:
                    self._hand.tell(f"{said!r} is none of these. {HELP}")

    def _is_taken(self, mark: Landmark) -> bool:
        """Writes down where the arm is, if it is still."""
        seen = rested(self._arms, self._arm, self._index)
        if isinstance(seen, str):
            self._hand.tell(seen)
            return False
        self._book.put(mark, seen)
        return True

    def _again(self, marks: Sequence[Landmark]) -> list[Landmark]:
        """The points that a person is going to touch again, because they do not fit the others."""
        if not marks:
            return []
        try:
            off = self._off(self._cell, self._index, self._book)
        except CalibrationError as error:
            words = f"{self._arm.name}: {error}. Names of points to touch again, or Enter: none"
            said = self._hand.bring(self._index, marks[0], words).split()
            return [mark for mark in marks if mark.name in said]
        limit = max(DOUBTFUL_M, DOUBTFUL * float(np.median(off))) if len(off) else 0.0
        far = dict(zip(self._book.touches, off.tolist(), strict=True))
        return [m for m in marks if far[m.name] > limit and self._is_again(m, far[m.name])]

    def _is_again(self, mark: Landmark, far_m: float) -> bool:
        far = 1e3 * far_m
        words = f"{self._arm.name}: {mark.name} is {far:.1f} mm off what the others say. {KEEP}"
        return self._hand.bring(self._index, mark, words).strip().lower() != "k"
