"""Files of measurements that survive whatever ends their writer."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import IO

from viskill_deploy.calibrate import measurements
from viskill_deploy.calibrate.measurements import Measurements
from viskill_deploy.core.description import CellArm
from viskill_deploy.core.errors import CalibrationError


class Book:
    """The CSV file of one arm, a row at a time.

    Args:
        path: the file; what it holds is kept.
        programme: says how the poses were chosen.
        arm: what is measured.
        point_m: how far beyond the jaw pivot, along the tip, the points are.

    Raises:
        CalibrationError: it holds another programme's measurements, or another arm's.

    Attributes:
        done: poses that need no more visit.
        visited: how many of them were visited.
        unseen: at how many of the last ones, running, nothing was seen.
    """

    def __init__(self, path: Path, programme: str, arm: CellArm, point_m: float) -> None:
        title = f"# programme: {programme}\n{measurements.arm_line(arm)}"
        title += f"{measurements.POINT_KEY} {point_m!r}\n"
        self.done = self.visited = self.unseen = 0
        if path.exists():
            self.done, self.visited = _resume(path, title)
            self._file: IO[str] = path.open("a", encoding="utf-8")
        else:
            self._file = path.open("w", encoding="utf-8")
            self._file.write(title + measurements.header())
            self._file.flush()

    def write(self, pose: int, is_moving: bool, row: Measurements | None) -> None:
        """Writes a row; a comment once a pose is done, seen or not.

        The system has it from then on, whatever becomes of this process. The disk gets it when the
        file is closed: the arms are on their way, and a disk may take longer than a control period.
        """
        if row is not None:
            self._file.write(measurements.line(row, 0))
        if not is_moving:
            self.done, self.visited = pose + 1, self.visited + 1
            self.unseen = 0 if row is not None else self.unseen + 1
            self._file.write(f"# pose {pose} done\n")
            self._file.flush()

    def give_up(self, pose: int) -> None:
        """Notes that an arm cannot get to a pose: it is left out from then on."""
        self.done = pose + 1
        self._file.write(f"# pose {pose} given up\n")
        self._file.flush()

    def close(self) -> None:
        """Closes the file, once it is on the disk."""
        self._file.flush()
        os.fsync(self._file.fileno())
        self._file.close()


def _resume(path: Path, title: str) -> tuple[int, int]:
    """Cuts a file off after the last pose that is over; the next one, and how many were visited.

    Raises:
        CalibrationError: it was written by another programme, or for another arm.
    """
    text = path.read_text(encoding="utf-8")
    title += measurements.header()
    if title.startswith(text):  # ended while its first lines were written
        text = title
        path.write_text(title, encoding="utf-8")
    if not text.startswith(title):
        raise CalibrationError(
            f"{path}: holds measurements of another programme, arm or version of this program; "
            "name another folder"
        )
    ends = list(re.finditer(r"^# pose (\d+) (done|given up)\n", text, re.MULTILINE))
    kept = text[: ends[-1].end()] if ends else title
    if kept != text:  # a file that stays as it is keeps its date, which is that of the calibration
        path.write_text(kept, encoding="utf-8")
    visited = sum(end.group(2) == "done" for end in ends)
    return (int(ends[-1].group(1)) + 1 if ends else 0), visited
