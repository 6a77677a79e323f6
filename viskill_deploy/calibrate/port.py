"""Where a port is: the point that the lines of a shaft come nearest to."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from viskill_deploy.calibrate.measurements import FARTHEST_M
from viskill_deploy.calibrate.registration import GATE
from viskill_deploy.core.description import CellArm
from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.kinematics.model import forward_batch
from viskill_deploy.safety.ceilings import MAX_PORT_OFFSET_M

LINE = ("x_m", "y_m", "z_m", "ux", "uy", "uz")
"""Columns of a measured shaft: a point on its axis, task frame, and the axis's direction."""

FEWEST = 4
"""Lines below which nobody could tell a wrong one."""

SPREAD_RAD = 0.1
"""Lines that are nearer to parallel than this (rms) leave the depth of the port open."""

WORST_M = 0.003
"""Lines that pass the point that fits them best at more than this (rms) have none in common."""

TRIALS = 200

_MEDIAN_OF_RAYLEIGH = 1.1774
"""Median distance of a line from a point on it, over the noise of each of the two coordinates."""


@dataclass(frozen=True)
class Port:
    """A registered port.

    Attributes:
        position: in the frame of the lines, (3,) m.
        covariance: (3, 3), m².
        distances_m: of the lines from it, (n,).
        is_inlier: whether a line took part, (n,).
    """

    position: FloatArray
    covariance: FloatArray
    distances_m: FloatArray
    is_inlier: npt.NDArray[np.bool_]

    @property
    def rms_m(self) -> float:
        """Root mean square distance of the lines that took part."""
        return float(np.sqrt((self.distances_m[self.is_inlier] ** 2).mean()))


def register_port(points: FloatArray, directions: FloatArray, seed: int = 0) -> Port:
    """The point nearest to lines of which some may be wrong, least squares.

    Pairs of lines are tried and the point with the smallest median distance is kept; then all
    lines near it are fitted together. A point p and unit direction u give (I - u u^T)(x - p) = 0.

    Args:
        points: one on every line, (n, 3) m.
        directions: of the lines, of any length, (n, 3).
        seed: of the pairs.

    Raises:
        CalibrationError: too few lines, lines that are parallel, numbers that are not finite or in
            another unit, or lines without a common point.
    """
    u = _checked(points, directions)
    rng = np.random.default_rng(seed)
    P = np.eye(3) - u[:, :, None] * u[:, None, :]  # onto the plane across each line
    best, x = np.inf, _nearest(P, points)
    for _ in range(TRIALS):
        pair = rng.choice(len(u), 2, replace=False)
        if np.linalg.norm(np.cross(*u[pair])) < SPREAD_RAD / 2.0:
            continue
        trial = _nearest(P[pair], points[pair])
        median = float(np.median(_distances(P, points, trial)))
        if median < best:
            best, x = median, trial
    inliers = np.ones(len(u), dtype=np.bool_)
    for _ in range(3):
        distances = _distances(P, points, x)
        scale = max(float(np.median(distances)) / _MEDIAN_OF_RAYLEIGH, 1e-9)
        inliers = distances <= GATE * np.sqrt(2.0) * scale
        _check_spread(P[inliers], int(inliers.sum()))
        x = _nearest(P[inliers], points[inliers])
    distances = _distances(P, points, x)
    kept = distances[inliers]
    rms = float(np.sqrt((kept**2).mean()))
    if rms > WORST_M:
        raise CalibrationError(
            f"the shaft's lines have no point in common (rms {1e3 * rms:.1f} mm); check that they "
            "are one arm's, and that the port stood still"
        )
    variance = float((kept**2).sum()) / max(2 * len(kept) - 3, 1)
    return Port(x, variance * np.linalg.inv(P[inliers].sum(axis=0)), distances, inliers)


def port_of(arm: CellArm, path: Path) -> Port:
    """An arm's port, in its base frame, from a file of its shaft.

    The file has either measured lines (columns `x_m, y_m, z_m, ux, uy, uz`, task frame) or, for an
    arm without a mechanical remote centre, joints (`q1_rad`, …) with the shaft free in the port.

    Raises:
        CalibrationError: as `register_port`; or the port of a PSM is not at its remote centre.
    """
    points, directions = _lines(arm, path)
    port = register_port(points, directions)
    R, origin = arm.T_task_base[:3, :3], arm.T_task_base[:3, 3]
    found = Port(
        R.T @ (port.position - origin),
        R.T @ port.covariance @ R,
        port.distances_m,
        port.is_inlier,
    )
    far = float(np.linalg.norm(found.position))
    if arm.arm.has_remote_centre and far > MAX_PORT_OFFSET_M:
        raise CalibrationError(
            f"{path}: the port would be {1e3 * far:.0f} mm from {arm.name}'s remote centre; the "
            "lines are in another frame, of another arm, or its base is wrong: calibrate that first"
        )
    return found


def _lines(arm: CellArm, path: Path) -> tuple[FloatArray, FloatArray]:
    """Points and directions of a shaft, task frame, (n, 3) each."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(f"{path}: cannot be read ({error}); give a CSV file") from error
    units = ["m" if joint.type == "prismatic" else "rad" for joint in arm.arm.joints]
    joints = tuple(f"q{i}_{unit}" for i, unit in enumerate(units, start=1))
    header = set(rows[0]) if rows else set()
    names = LINE if header >= set(LINE) or arm.arm.has_remote_centre else joints
    try:
        values = np.array([[float(row[name] or "") for name in names] for row in rows])
    except (KeyError, ValueError, TypeError) as error:
        raise CalibrationError(
            f"{path}: needs numbers in the columns {', '.join(names)} ({error}); correct it"
        ) from error
    if names is LINE:
        table = values.reshape(-1, 6)
        return table[:, :3], table[:, 3:]
    if not np.isfinite(values).all():
        raise CalibrationError(f"{path}: a joint is not finite; take that row out")
    T = arm.T_task_base @ forward_batch(arm.arm, values.reshape(-1, len(joints)))
    return T[:, :3, 3], T[:, :3, 2]


def _checked(points: FloatArray, directions: FloatArray) -> FloatArray:
    """Unit directions of lines that make sense."""
    if len(points) != len(directions) or len(points) < FEWEST:
        raise CalibrationError(f"{len(points)} lines of the shaft; measure at least {FEWEST}")
    if not (np.isfinite(points).all() and np.isfinite(directions).all()):
        raise CalibrationError("a line holds a number that is not finite; take that row out")
    if np.abs(points).max() > FARTHEST_M:
        raise CalibrationError(
            f"a line's point is {np.abs(points).max():.4g} m away; points are in m in the task "
            "frame, these look like mm"
        )
    lengths = np.linalg.norm(directions, axis=1)
    if lengths.min() < 1e-9:
        raise CalibrationError("a line has a direction of no length; take that row out")
    return np.asarray(directions / lengths[:, None])


def _check_spread(P: FloatArray, count: int) -> None:
    # the least eigenvalue is the mean square sine of the angle to the most parallel direction
    least = float(np.linalg.eigvalsh(P.mean(axis=0))[0]) if count else 0.0
    if count < FEWEST or least < SPREAD_RAD**2:
        angle = np.degrees(np.sqrt(max(least, 0.0)))
        raise CalibrationError(
            f"{count} lines of the shaft fit together, within {angle:.1f} degrees of one direction "
            "(rms), so the port's depth is open; tilt the shaft more, to all sides"
        )


def _nearest(P: FloatArray, points: FloatArray) -> FloatArray:
    """Least squares point of lines, (3,); some point of them where they are parallel."""
    A, b = P.sum(axis=0), np.einsum("nij,nj->i", P, points)
    return np.asarray(np.linalg.lstsq(A, b, rcond=None)[0], dtype=np.float64)


def _distances(P: FloatArray, points: FloatArray, x: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(np.einsum("nij,nj->ni", P, x - points), axis=1))
