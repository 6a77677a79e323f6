"""Measuring by touch: a person brings tips to points whose place is known; we only listen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from viskill_deploy.calibrate.fit import FEWEST, misfits
from viskill_deploy.calibrate.landmarks import Landmark
from viskill_deploy.calibrate.resting import Arms, rested
from viskill_deploy.calibrate.touch_book import TouchBook
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import CalibrationError, Interrupted

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


def touch(
    cell: CellDescription,
    arms: Arms,
    hand: Hand,
    wanted: Sequence[Sequence[Landmark]],
    folder: Path,
) -> dict[str, TouchBook]:
    """Has every arm touch its points, and writes each down; goes on where it was.

    Args:
        cell: the arms as their files have them.
        arms: reports their joints.
        hand: who brings them there.
        wanted: points of every arm.
        folder: gets `<arm>.csv`.

    Returns:
        The touches of every arm, by name.

    Raises:
        CalibrationError: the folder holds something else.
        Interrupted: they stopped; what was touched is kept.
        DriverError: an arm is lost; what was touched is kept.
    """
    folder.mkdir(parents=True, exist_ok=True)
    title = f"touch: cell {cell.name}"
    books = {
        arm.name: TouchBook(folder / f"{arm.name}.csv", title, arm.arm.jaw.finger_length_m)
        for arm in cell.arms
    }
    hand.tell(HELP)
    for index, (book, marks) in enumerate(zip(books.values(), wanted, strict=True)):
        _Touching(cell, arms, hand, book, index).all_of(marks)
    return books


class _Touching:
    """One arm's points."""

    def __init__(
        self, cell: CellDescription, arms: Arms, hand: Hand, book: TouchBook, index: int
    ) -> None:
        self._arm, self._arms, self._hand = cell.arms[index], arms, hand
        self._book, self._index = book, index

    def all_of(self, marks: Sequence[Landmark]) -> None:
        """All points that were not touched yet, and then the doubtful ones again."""
        self._each([mark for mark in marks if mark.name not in self._book.touches], marks)
        for _ in range(ROUNDS):
            doubtful = self._doubtful()
            again = [m for m in marks if m.name in doubtful and self._is_again(m, doubtful)]
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

    def _doubtful(self) -> dict[str, float]:
        """How far, m, the touches are off that do not fit the others, by name of the point."""
        if len(self._book.touches) < FEWEST:
            return {}
        try:
            off = misfits(self._arm, self._book.measurements())
        except CalibrationError as error:
            self._hand.tell(f"{self._arm.name}: {error}")
            return {}
        limit = max(DOUBTFUL_M, DOUBTFUL * float(sorted(off)[len(off) // 2]))
        pairs = zip(self._book.touches, off.tolist(), strict=True)
        return {name: far for name, far in pairs if far > limit}

    def _is_again(self, mark: Landmark, doubtful: dict[str, float]) -> bool:
        far = 1e3 * doubtful[mark.name]
        words = f"{self._arm.name}: {mark.name} is {far:.1f} mm off what the others say. {KEEP}"
        return self._hand.bring(self._index, mark, words).strip().lower() != "k"
