"""The file of an arm's touches: it is whole after every one of them, and `fit` reads it."""

from __future__ import annotations

import csv
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from viskill_deploy.calibrate import measurements
from viskill_deploy.calibrate.landmarks import Landmark
from viskill_deploy.calibrate.measurements import Measurements
from viskill_deploy.calibrate.resting import Rested
from viskill_deploy.core.description import CellArm
from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.core.types import FloatArray

COLUMN = "landmark"
"""The column that says which point was touched; `fit` does not need it."""


@dataclass(frozen=True)
class Touch:
    """One point that an arm has touched.

    Attributes:
        stamp_s: when, driver's clock.
        joints: what the arm reported there, (6,).
        position: where the point is, (3,) m.
    """

    stamp_s: float
    joints: FloatArray
    position: FloatArray


class TouchBook:
    """Touches of one arm by name of the point, kept on the disk.

    Args:
        path: its file, `<arm>.csv`; what is there already is kept.
        title: says what the points belong to; a file with another title is refused.
        arm: what touches them; likewise.

    Attributes:
        touches: by name of the point, in the order of touching.

    Raises:
        CalibrationError: the file holds something else, or cannot be read.
    """

    def __init__(self, path: Path, title: str, arm: CellArm) -> None:
        self.path, self._point_m = path, arm.arm.jaw.finger_length_m
        self._head = (
            f"# {title}\n{measurements.arm_line(arm)}{measurements.POINT_KEY} {self._point_m!r}\n"
        )
        self.touches: dict[str, Touch] = {}
        if path.exists():
            self._resume()

    def put(self, landmark: Landmark, seen: Rested) -> None:
        """Writes a touch down; it replaces an earlier one of the same point."""
        self.touches.pop(landmark.name, None)
        self.touches[landmark.name] = Touch(seen.stamp_s, seen.joints, landmark.position)
        self._save()

    def drop(self, name: str) -> None:
        """Takes a touch back."""
        del self.touches[name]
        self._save()

    def measurements(self) -> Measurements:
        """The touches as `fit` sees them: at rest, and nobody knows which way the wrist came."""
        touches = list(self.touches.values())
        n = len(touches)
        return Measurements(
            np.array([touch.stamp_s for touch in touches]),
            np.array([touch.joints for touch in touches]).reshape(n, 6),
            np.zeros((n, 6)),
            np.zeros((n, 3)),
            np.array([touch.position for touch in touches]).reshape(n, 3),
            self._point_m,
        )

    def _save(self) -> None:
        """The whole file beside the old one, then in its place: no moment without a whole file."""
        rows = self.measurements()
        lines = [f"{measurements.header().strip()},{COLUMN}\n"]
        lines += [f"{measurements.line(rows, i).strip()},{n}\n" for i, n in enumerate(self.touches)]
        beside = self.path.with_suffix(".new")
        with beside.open("w", encoding="utf-8") as file:
            file.write(self._head + "".join(lines))
            file.flush()
            os.fsync(file.fileno())
        beside.replace(self.path)

    def _resume(self) -> None:
        if not self.path.read_text(encoding="utf-8").startswith(self._head):
            raise CalibrationError(
                f"{self.path}: holds other measurements than touches of these points; name another "
                "folder"
            )
        names, rows = touched(self.path), measurements.load(self.path)
        self.touches = {
            name: Touch(float(rows.stamps[i]), rows.joints[i], rows.points[i])
            for i, name in enumerate(names)
        }


def touched(path: Path) -> list[str]:
    """Names of the points in a file of touches, row by row.

    Raises:
        CalibrationError: the file has none.
    """
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    names = [row.get(COLUMN) or "" for row in rows]
    if not all(names):
        raise CalibrationError(
            f"{path}: has no column {COLUMN!r}; measure with `viskill calibrate collect FOLDER "
            "--source touch`"
        )
    return names
