"""The pose of a rigid thing from points of it that somebody touched, and how well it is known."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from viskill_deploy.calibrate.registration import FEWEST, register, rigid
from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.core.types import FloatArray

TOUCH_M = 0.0005
"""Standard deviation of a coordinate that is expected of a touch, as `fit.NOISE_M`."""

TRUST = 6
"""That expectation counts as much as so many coordinates: three points leave three to judge by."""

NEAR_M = 0.0017
"""Three of these standard deviations, in space: a touch that is nearer to its place is never wrong,
however well a few others agree by chance."""

WORST_RMS_M = 0.002
"""Points that a rigid pose misses by more than this are not those of the thing."""

UPRIGHT = 0.8
"""Cosine of the farthest tilt of a thing that stands on the board."""


@dataclass(frozen=True)
class PoseFit:
    """Where a thing is.

    Attributes:
        T: its pose in the task frame, (4, 4).
        covariance: of its position, m², and of a small rotation about the task frame's axes,
            rad², (6, 6).
        distances_m: of its points from where the pose has them, (n,).
        held_out_m: the same from a pose that has not seen the point, (n,); NaN for three points.
        is_inlier: whether a point took part, (n,).
    """

    T: FloatArray
    covariance: FloatArray
    distances_m: FloatArray
    held_out_m: FloatArray
    is_inlier: npt.NDArray[np.bool_]

    @property
    def turn_rad(self) -> float:
        """Angle between its axes and the task frame's."""
        return float(np.linalg.norm(pin.log3(self.T[:3, :3])))


def fit_pose(points: FloatArray, seen: FloatArray, arm_m: float = 0.0) -> PoseFit:
    """The rigid pose that brings a thing's points to where they were touched.

    Args:
        points: in the thing's frame, (n, 3) m.
        seen: the same in the task frame, (n, 3) m.
        arm_m: error that all touches have in common, standard deviation of a coordinate: what the
            arm's calibration leaves. No number of points makes it smaller.

    Raises:
        CalibrationError: fewer than three points, points in one line or not finite, or points that
            no rigid pose brings together.
    """
    found = register(points, seen)
    T, kept = rigid(points, seen), np.ones(len(points), dtype=np.bool_)
    if _distances(T, points, seen).max() > NEAR_M:
        T = found.T
        for _ in range(2):
            kept = found.is_inlier | (_distances(T, points, seen) <= NEAR_M)
            T = rigid(points[kept], seen[kept])
    distances = _distances(T, points, seen)
    squares = float((distances[kept] ** 2).sum())
    rms = math.sqrt(squares / int(kept.sum()))
    if rms > WORST_RMS_M:
        worst = int(np.argmax(distances))
        raise CalibrationError(
            f"no pose brings the touched points together (rms {1e3 * rms:.1f} mm, point "
            f"{worst + 1} is off by {1e3 * distances[worst]:.1f} mm); check which points were "
            "touched, and touch them again"
        )
    freedom = 3 * int(kept.sum()) - 6
    variance = (TRUST * TOUCH_M**2 + squares) / (TRUST + freedom)
    J = _jacobian(T, points[kept])
    covariance = np.asarray(variance * np.linalg.inv(J.T @ J), dtype=np.float64)
    covariance[:3, :3] += arm_m**2 * np.eye(3)
    return PoseFit(T, covariance, distances, _held_out(points, seen, kept), kept)


def fit_corners(points: FloatArray, seen: FloatArray, arm_m: float = 0.0) -> PoseFit:
    """The same for a thing that looks alike from several sides, whichever corner was touched first.

    Of the orders that fit, that counts which leaves the thing upright and turned least.

    Raises:
        CalibrationError: as `fit_pose`; or the thing lies on its side.
    """
    fits = list[PoseFit]()
    refusal: CalibrationError | None = None
    for order in itertools.permutations(range(len(points))):
        try:
            fits.append(fit_pose(points[list(order)], seen, arm_m))
        except CalibrationError as error:
            refusal = refusal or error
    upright = [fit for fit in fits if fit.T[2, 2] >= UPRIGHT]
    if not upright:
        raise refusal or CalibrationError(
            "the touched corners are those of a thing that is tilted or lies on its side; put it "
            "upright, and touch the corners of its top"
        )
    best = min(float(fit.distances_m.mean()) for fit in upright)
    alike = [fit for fit in upright if float(fit.distances_m.mean()) < best + 1e-6]
    return min(alike, key=lambda fit: abs(math.atan2(fit.T[1, 0], fit.T[0, 0])))


def _jacobian(T: FloatArray, points: FloatArray) -> FloatArray:
    """How seen points change with position and a small rotation, (3 n, 6)."""
    arms = points @ T[:3, :3].T
    return np.concatenate([np.hstack([np.eye(3), -pin.skew(arm)]) for arm in arms])


def _distances(T: FloatArray, points: FloatArray, seen: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(seen - (points @ T[:3, :3].T + T[:3, 3]), axis=1))


def _held_out(points: FloatArray, seen: FloatArray, kept: npt.NDArray[np.bool_]) -> FloatArray:
    """Distance of every point from the pose that the other good ones give, (n,) m."""
    distances = np.full(len(points), np.nan)
    for i in range(len(points)):
        rest = kept.copy()
        rest[i] = False
        if rest.sum() >= FEWEST:
            T = rigid(points[rest], seen[rest])
            distances[i] = np.linalg.norm(seen[i] - (T[:3, :3] @ points[i] + T[:3, 3]))
    return distances
