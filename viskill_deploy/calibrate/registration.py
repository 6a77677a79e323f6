"""Rigid registration of paired points, in closed form, and robust to points that are wrong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.core.types import FloatArray

FEWEST = 3
"""Paired points that a rigid transform needs."""

SPREAD_M = 0.002
"""Points that lie nearer to one line than this (rms) leave a rotation about it open."""

TRIALS = 300
"""Random triples that are tried: with 40 % wrong points one triple in five is clean."""

GATE = 3.5
"""Points further away than this many robust standard deviations are wrong."""

_MEDIAN_OF_CHI3 = 1.5382
"""Median length of a vector of three standard normal numbers."""


@dataclass(frozen=True)
class Registration:
    """A rigid transform between paired points.

    Attributes:
        T: transform that takes `source` to `target`, (4, 4), m.
        residuals: target minus transformed source, (n, 3), m.
        is_inlier: whether a pair took part, (n,).
    """

    T: FloatArray
    residuals: FloatArray
    is_inlier: npt.NDArray[np.bool_]

    @property
    def rms_m(self) -> float:
        """Root mean square distance of the pairs that took part, m."""
        return float(np.sqrt((self.residuals[self.is_inlier] ** 2).sum(axis=1).mean()))


def rigid(source: FloatArray, target: FloatArray) -> FloatArray:
    """The rigid transform that brings `source` nearest to `target`, least squares.

    Source: Umeyama, IEEE PAMI 13(4), 1991, without scale.

    Args:
        source: points, (n, 3), m.
        target: the same points in the other frame, (n, 3), m.

    Returns:
        T with target = T source, (4, 4).
    """
    a, b = source.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((target - b).T @ (source - a))
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    T = np.eye(4)
    T[:3, :3] = U @ turn @ Vt
    T[:3, 3] = b - T[:3, :3] @ a
    return T


def register(source: FloatArray, target: FloatArray, seed: int = 0) -> Registration:
    """The rigid transform between paired points of which some may be wrong.

    Random triples are tried and the one with the smallest median distance is kept (least median
    of squares, breaks down at half of the points); then everything near it is fitted together.

    Args:
        source: points, (n, 3), m.
        target: the same points in the other frame, (n, 3), m.
        seed: of the random triples.

    Raises:
        CalibrationError: fewer than three pairs, points that all lie on one line, or numbers that
            are not finite.
    """
    _check(source, target)
    rng = np.random.default_rng(seed)
    best, T = np.inf, rigid(source, target)
    for _ in range(TRIALS if len(source) > FEWEST else 0):
        triple = rng.choice(len(source), FEWEST, replace=False)
        if _line_distance(source[triple]) < SPREAD_M:
            continue
        trial = rigid(source[triple], target[triple])
        median = float(np.median(_distances(trial, source, target)))
        if median < best:
            best, T = median, trial
    inliers = np.ones(len(source), dtype=np.bool_)
    for _ in range(3):
        distances = _distances(T, source, target)
        scale = float(np.median(distances)) / _MEDIAN_OF_CHI3
        inliers = distances <= max(GATE * scale, 1e-9) * np.sqrt(3.0)
        if inliers.sum() < FEWEST or _line_distance(source[inliers]) < SPREAD_M:
            inliers[:] = True  # nothing stands out: keep all and let the residuals tell
        T = rigid(source[inliers], target[inliers])
    residuals = target - (source @ T[:3, :3].T + T[:3, 3])
    return Registration(T, residuals, inliers)


def _check(source: FloatArray, target: FloatArray) -> None:
    if len(source) != len(target) or len(source) < FEWEST:
        raise CalibrationError(
            f"{len(source)} and {len(target)} paired points; give at least {FEWEST} pairs"
        )
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise CalibrationError("a point holds a number that is not finite; take that row out")
    for points, name in ((source, "robot"), (target, "measured")):
        if _line_distance(points) < SPREAD_M:
            raise CalibrationError(
                f"the {name} points lie within {SPREAD_M * 1e3:g} mm of one line, so the rotation "
                "about it is open; spread them over the workspace"
            )


def _line_distance(points: FloatArray) -> float:
    """How far points are from the line that fits them best, rms, m."""
    values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(np.sqrt((values[1:] ** 2).sum() / len(points)))


def _distances(T: FloatArray, source: FloatArray, target: FloatArray) -> FloatArray:
    distances: FloatArray = np.linalg.norm(target - (source @ T[:3, :3].T + T[:3, 3]), axis=1)
    return distances
