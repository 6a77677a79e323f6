"""Poses of still things as a tracker sees them: recorded, averaged, and how well they are known."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from viskill_deploy.calibrate.registration import GATE
from viskill_deploy.core.clock import Clock
from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.core.scene_files import FARTHEST_M
from viskill_deploy.core.types import FloatArray
from viskill_deploy.runtime.poses import PoseSource

COLUMNS = ("stamp_s", "name", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
"""Of a file of poses."""

FEWEST = 5
"""Looks at a thing below which nobody could tell a wrong one."""

STILL_M, STILL_RAD = 0.003, 0.1
"""Spread (rms) of looks that fit together, above which the thing moves, or the tracker is lost."""

LOOK_S = 0.01

UNIT = 1e-3
"""How far the length of a quaternion may be from 1."""


@dataclass(frozen=True)
class PoseMean:
    """Where a thing was seen.

    Attributes:
        T: its pose, (4, 4).
        covariance: of position and of a small rotation about the task frame's axes, (6, 6).
        looks: how many took part.
        left_out: how many did not fit them.
    """

    T: FloatArray
    covariance: FloatArray
    looks: int
    left_out: int


def averaged(name: str, T: FloatArray, accuracy_m: float, accuracy_rad: float) -> PoseMean:
    """The pose of a still thing from many looks, of which some may be wrong.

    Looks are held against the median position and against the rotation that is nearest to all
    others; those within a gate are averaged.

    Args:
        name: of the thing, for messages.
        T: its poses, (n, 4, 4).
        accuracy_m: of the tracker, standard deviation on an axis: what it gets wrong at every look
            alike does not go away by looking again.
        accuracy_rad: the same of a turn.

    Raises:
        CalibrationError: too few looks, or a thing that moves.
    """
    if len(T) < FEWEST:
        raise CalibrationError(
            f"{name} was seen {len(T)} times; look for longer, or see that the tracker sees it"
        )
    p, R = T[:, :3, 3], T[:, :3, :3]
    kept = _near(np.linalg.norm(p - np.median(p, axis=0), axis=1))
    kept &= _near(_angles(R, _middle(R[kept])))
    if kept.sum() < FEWEST:
        raise CalibrationError(f"the looks at {name} do not agree; see that it lies still")
    mean, turn = p[kept].mean(axis=0), _mean(R[kept])
    rest = np.hstack([p[kept] - mean, [pin.log3(each @ turn.T) for each in R[kept]]])
    spread = np.sqrt((rest**2).sum(axis=0) / len(rest))
    if np.linalg.norm(spread[:3]) > STILL_M or np.linalg.norm(spread[3:]) > STILL_RAD:
        raise CalibrationError(
            f"{name} moves, or the tracker is lost: its position spreads by "
            f"{1e3 * np.linalg.norm(spread[:3]):.1f} mm; let it lie still and look again"
        )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, mean
    n = int(kept.sum())
    covariance = rest.T @ rest / (n * max(n - 1, 1))
    covariance += np.diag([accuracy_m**2] * 3 + [accuracy_rad**2] * 3)
    return PoseMean(pose, np.asarray(covariance), n, len(T) - n)


def look_on(source: PoseSource, names: Sequence[str], clock: Clock, seconds: float) -> Looks:
    """Every new look at things for some time."""
    looks: dict[str, list[tuple[float, FloatArray]]] = {name: [] for name in names}
    end = clock.now() + seconds
    while clock.now() < end:
        for name in names:
            seen = source.newest(name)
            if seen is not None and (not looks[name] or seen.seen_s > looks[name][-1][0]):
                looks[name].append((seen.seen_s, np.array(seen.T_task_object)))
        clock.sleep_until(clock.now() + LOOK_S)
    return looks


Looks = Mapping[str, Sequence[tuple[float, FloatArray]]]
"""Time and pose (4, 4) of every look at a thing, by its name."""


def write_looks(path: Path, looks: Looks) -> Path:
    """Writes looks as a file of poses; returns its path."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for name, rows in looks.items():
            for stamp, T in rows:
                q = pin.Quaternion(T[:3, :3]).coeffs().tolist()
                writer.writerow(
                    [repr(x) if x != name else x for x in (stamp, name, *T[:3, 3].tolist(), *q)]
                )
    return path


def read_looks(path: Path) -> Looks:
    """The looks in a file of poses.

    Raises:
        CalibrationError: no such file, a missing column, a row that is no pose or in mm; names it.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: cannot be read ({error}); give a CSV file") from error
    looks = dict[str, list[tuple[float, FloatArray]]]()
    for number, row in enumerate(rows, start=1):
        try:
            stamp, *numbers = (float(row[key] or "") for key in COLUMNS if key != "name")
        except (KeyError, TypeError, ValueError) as error:
            raise CalibrationError(
                f"{path}: row {number}: needs a number in each of {', '.join(COLUMNS)} ({error})"
            ) from error
        values = np.array(numbers)
        q = values[3:]
        if not (np.isfinite(values).all() and abs(float(np.linalg.norm(q)) - 1.0) <= UNIT):
            raise CalibrationError(f"{path}: row {number} is no pose; take it out")
        if np.abs(values[:3]).max() > FARTHEST_M:
            raise CalibrationError(
                f"{path}: row {number} is farther than 1 m away; positions are in m, in the task "
                "frame"
            )
        T = np.eye(4)
        T[:3, :3] = pin.Quaternion(*(q / np.linalg.norm(q))[[3, 0, 1, 2]].tolist()).matrix()
        T[:3, 3] = values[:3]
        looks.setdefault(row["name"], []).append((stamp, T))
    return looks


def _near(distances: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Those within the gate of a robust standard deviation, (n,)."""
    limit = max(GATE * 1.4826 * float(np.median(distances)), 1e-9)
    return np.asarray(distances <= limit)


def _angles(R: FloatArray, to: FloatArray) -> FloatArray:
    """Angles between rotations and one, (n,) rad."""
    traces = np.einsum("nij,ij->n", R, to)
    return np.asarray(np.arccos(np.clip((traces - 1.0) / 2.0, -1.0, 1.0)))


def _middle(R: FloatArray) -> FloatArray:
    """The rotation whose angles to the others are least in all, (3, 3)."""
    some = R[:: max(1, len(R) // 50)]
    return np.asarray(some[int(np.argmin([np.sum(_angles(R, each)) for each in some]))])


def _mean(R: FloatArray) -> FloatArray:
    """The rotation nearest to all in the sense of least squares, (3, 3)."""
    U, _, Vt = np.linalg.svd(R.sum(axis=0))
    return np.asarray(U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt)
