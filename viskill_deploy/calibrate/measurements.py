"""Measured points and the joints behind them: one row a point, in CSV that people can write."""

from __future__ import annotations

import csv
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.description import CellArm
from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.core.types import FloatArray, frozen_array

_JOINTS = ("q1_rad", "q2_rad", "q3_m", "q4_rad", "q5_rad", "q6_rad")
_SPEEDS = ("v1_rad_s", "v2_rad_s", "v3_m_s", "v4_rad_s", "v5_rad_s", "v6_rad_s")
_ACCELERATIONS = (
    "a1_rad_s2",
    "a2_rad_s2",
    "a3_m_s2",
    "a4_rad_s2",
    "a5_rad_s2",
    "a6_rad_s2",
)
_TURNS = ("turn4", "turn5", "turn6")
_POINT = ("x_m", "y_m", "z_m")

COLUMNS = ("stamp_s", *_JOINTS, *_SPEEDS, *_TURNS, *_POINT, *_ACCELERATIONS)
"""Of the file. Speeds and turns may be left out: the delay, or the backlash, stays unknown then.
Without accelerations the delay is known a little worse."""

POINT_KEY = "# point_m:"
"""A comment of a file that begins so says how far from the jaw pivot its points are, m."""

ARM_KEY = "# arm:"
"""A comment of a file that begins so says which arm was measured."""

FARTHEST_M = 2.0
"""A measured point further from the task frame's origin is in another unit."""

SHALLOWEST = 1.0
"""Insertions above this, m, are in another unit."""


_WIDTHS = {"joints": 6, "speeds": 6, "turns": 3, "points": 3, "accelerations": 6}


@dataclass(frozen=True)
class Measurements:
    """Points of one arm's tip as something else than its joints saw them.

    Attributes:
        stamps: when, (n,) s, for people and for looking rows up.
        joints: what the arm reported, (n, 6), rad and m.
        speeds: likewise, (n, 6), rad/s and m/s; zeros at rest.
        turns: which way roll, wrist pitch and wrist yaw moved last, -1, 0 (not known) or 1, (n, 3).
        points: where the point was, task frame, (n, 3) m.
        point_m: stated distance of the point from the jaw pivot along the tip's z, m.
        accelerations: of the joints, (n, 6), rad/s^2 and m/s^2; zeros where not given.

    Raises:
        CalibrationError: a number is not finite; names the row.
    """

    stamps: FloatArray
    joints: FloatArray
    speeds: FloatArray
    turns: FloatArray
    points: FloatArray
    point_m: float = 0.0
    accelerations: FloatArray = field(default_factory=lambda: np.zeros((0, 6)))

    def __post_init__(self) -> None:
        n = len(self.stamps)
        if n and not len(self.accelerations):
            object.__setattr__(self, "accelerations", np.zeros((n, 6)))
        for name in ("stamps", *_WIDTHS):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            bad = np.flatnonzero(~np.isfinite(values).all(axis=tuple(range(1, values.ndim))))
            if bad.size:
                raise CalibrationError(
                    f"row {bad[0] + 1} of {name} holds a number that is not finite "
                    f"({bad.size} such rows); take them out"
                )
        for name, width in _WIDTHS.items():
            object.__setattr__(self, name, frozen_array(getattr(self, name), (n, width), name))
        object.__setattr__(self, "stamps", frozen_array(self.stamps, (n,), "stamps"))

    def __len__(self) -> int:
        return len(self.stamps)

    def chosen(self, rows: npt.NDArray[np.bool_] | npt.NDArray[np.intp]) -> Measurements:
        """Some of the rows."""
        return Measurements(
            self.stamps[rows],
            self.joints[rows],
            self.speeds[rows],
            self.turns[rows],
            self.points[rows],
            self.point_m,
            self.accelerations[rows],
        )

    def check(self) -> None:
        """Looks for what no fit can make good.

        Raises:
            CalibrationError: a number is in another unit; names the row.
        """
        far = np.flatnonzero(np.abs(self.points).max(axis=1, initial=0.0) > FARTHEST_M)
        if far.size:
            raise CalibrationError(
                f"row {far[0] + 1} lies {np.abs(self.points[far[0]]).max():.4g} m away "
                f"({far.size} such rows); points are in m in the task frame, these look like mm"
            )
        if np.abs(self.joints[:, 2]).max(initial=0.0) > SHALLOWEST:
            raise CalibrationError("insertions above 1 m; joint 3 is in m, this looks like mm")
        if np.abs(self.joints[:, [0, 1, 4, 5]]).max(initial=0.0) > np.pi:
            raise CalibrationError(
                "joint angles above pi; joints are in rad, these look like degrees"
            )


def arm_line(arm: CellArm) -> str:
    """The line that says which arm was measured."""
    return f"{ARM_KEY} {arm.name} {arm.entry.robot} {arm.entry.serial} {arm.entry.tool}\n"


def load(path: Path, point_m: float | None = None, arm: CellArm | None = None) -> Measurements:
    """Reads a CSV file with the columns of `COLUMNS`, in any order, others ignored.

    Args:
        path: the file.
        point_m: from the jaw pivot to the measured points; what the file says by default, else 0.
        arm: whose measurements they have to be, where the file says whose they are.

    Raises:
        CalibrationError: no such file, a missing column, an entry that is no number, or the
            measurements are another arm's; names it.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            lines = list(file)
        reader = csv.DictReader(line for line in lines if not line.startswith("#"))
        rows, header = list(reader), reader.fieldnames or []
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: cannot be read ({error}); give a CSV file") from error
    missing = [name for name in ("stamp_s", *_JOINTS, *_POINT) if name not in header]
    if missing:
        raise CalibrationError(f"{path}: column {missing[0]!r} is missing; it needs {missing}")

    def columns(names: tuple[str, ...]) -> FloatArray:
        if any(name not in header for name in names):
            return np.zeros((len(rows), len(names)))
        values = [
            [_number(path, i, name, row[name]) for name in names] for i, row in enumerate(rows)
        ]
        return np.array(values, dtype=np.float64).reshape(len(rows), len(names))

    whose = next((x for x in lines if x.startswith(ARM_KEY)), None)
    if arm is not None and whose not in (None, arm_line(arm)):
        raise CalibrationError(
            f"{path}: was measured on {str(whose).removeprefix(ARM_KEY).strip()}, and the cell has "
            f"{arm_line(arm).removeprefix(ARM_KEY).strip()}; name the cell that was measured with "
            "--robot"
        )
    stated = next((x for x in lines if x.startswith(POINT_KEY)), f"{POINT_KEY} 0.0")
    if point_m is None:
        point_m = _number(path, -1, POINT_KEY, stated.removeprefix(POINT_KEY))
    stamps = columns(("stamp_s",))[:, 0]
    joints, speeds, accelerations = columns(_JOINTS), columns(_SPEEDS), columns(_ACCELERATIONS)
    turns, points = columns(_TURNS), columns(_POINT)
    return Measurements(stamps, joints, speeds, turns, points, point_m, accelerations)


def header() -> str:
    """First line of a file."""
    return ",".join(COLUMNS) + "\n"


def line(measurements: Measurements, row: int) -> str:
    """One row of a file, to the last bit."""
    m = measurements
    values = (m.joints, m.speeds, m.turns, m.points, m.accelerations)
    numbers = (m.stamps[row], *(number for part in values for number in part[row]))
    return ",".join(repr(float(number)) for number in numbers) + "\n"


def save(measurements: Measurements, path: Path) -> None:
    """Writes a CSV file that `load` reads back bit for bit."""
    text = header() + "".join(line(measurements, row) for row in range(len(measurements)))
    path.write_text(text, encoding="utf-8")


def _number(path: Path, row: int, name: str, text: str | None) -> float:
    try:
        return float(text or "")
    except ValueError as error:
        raise CalibrationError(
            f"{path}: row {row + 1}, column {name!r}: {text!r} is no number; correct it"
        ) from error
