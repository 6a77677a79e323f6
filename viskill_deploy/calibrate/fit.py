"""Fitting an arm's errors to measured points: robust, with sigmas, and honest about blind spots."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pinocchio as pin
from scipy.optimize import least_squares  # type: ignore[import-untyped]

from viskill_deploy.calibrate.error_model import ErrorModel
from viskill_deploy.calibrate.measurements import Measurements
from viskill_deploy.calibrate.parameters import (
    BASE_ROTATION,
    BASE_TRANSLATION,
    INSERTION,
    NAMES,
    PARAMETERS,
    USUAL,
    errors_of,
)
from viskill_deploy.calibrate.registration import GATE, register
from viskill_deploy.core.arm_errors import ArmErrors
from viskill_deploy.core.description import CellArm
from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.core.types import FloatArray

FEWEST = 6
"""Points below which nothing is fitted; the touch programme takes at least 8."""

ROWS_PER_PARAMETER = 1.5
"""Coordinates that there must be for each fitted parameter; its usual size is one more."""

BLIND = 1.0
"""A direction of parameter space in which data at `NOISE_M` say less than this many times what the
usual sizes say is not seen."""

NOISE_M = 0.0005
"""Noise that blindness is judged at: a good tracker, or a careful touch."""

FARTHEST_TURN_RAD = 0.35
"""A base turned by more than 20 degrees is no calibration error: it is another frame."""

FARTHEST_M = 0.06
"""Likewise, a base that is moved by more."""

WORST_RMS_M = 0.008
"""A rigid fit worse than this: the points are not this arm's."""

HELD_OUT = 0.2
"""Part of the rows that judges a fit that has not seen them."""

ROUNDS = 3
"""Of estimating the noise."""

FEWEST_TO_SPLIT = 40
"""Below so many rows every one is left out in turn instead."""


@dataclass(frozen=True)
class ArmFit:
    """A calibrated arm.

    Attributes:
        errors: what differs from the arm's file.
        vector: the same, in the order of `parameters.NAMES`, (27,).
        sigma: standard deviation of each, NaN where frozen, (27,).
        covariance: of the fitted ones, (27, 27), 0 where frozen.
        frozen: names of parameters that the data cannot tell, kept at 0.
        is_outlier: rows that do not fit the rest, (n,).
        residuals: measured minus fitted points, (n, 3), m.
        held_out_m: distances of rows from a fit that has not seen them, outliers left out.
        noise_m: standard deviation of a coordinate, as the residuals tell.
        singular_values: of the Jacobian in units of usual size over `NOISE_M`, before freezing.
    """

    errors: ArmErrors
    vector: FloatArray
    sigma: FloatArray
    covariance: FloatArray
    frozen: tuple[str, ...]
    is_outlier: npt.NDArray[np.bool_]
    residuals: FloatArray
    held_out_m: FloatArray
    noise_m: float
    singular_values: FloatArray

    @property
    def rms_m(self) -> float:
        """Root mean square distance of the rows that are no outliers, m."""
        return float(np.sqrt((self.residuals[~self.is_outlier] ** 2).sum(axis=1).mean()))


def fit_arm(arm: CellArm, measured: Measurements, seed: int = 0) -> ArmFit:
    """The errors of one arm.

    The base is registered first, which also finds points that belong to something else. Then all
    parameters that the data can tell are fitted together through Pinocchio's Jacobian, first with
    a robust loss, then on the rows that fit.

    Args:
        arm: nominal arm in its cell.
        measured: points of its tip in the task frame.
        seed: of the split into fitted and held-out rows.

    Raises:
        CalibrationError: too few points, points in one line or place, in another unit or frame, or
            of another arm; says what to do.
    """
    measured.check()
    if len(measured) < FEWEST:
        raise CalibrationError(f"{len(measured)} points; measure at least {FEWEST}, better 10")
    model = ErrorModel(arm)
    start = _registered(model, arm, measured)
    is_free, values = _seen(model, start, measured)
    vector, outliers = _robust(model, start, is_free, measured)
    # what was judged at the nominal arm is judged again where the arm turned out to be
    is_free, values = _seen(model, vector, measured.chosen(~outliers))
    vector, outliers = _robust(model, np.where(is_free, vector, 0.0), is_free, measured)
    clean = measured.chosen(~outliers)
    noise, covariance = _spread(model, vector, is_free, clean)
    held_out = _held_out(model, vector, is_free, clean, noise, seed)
    residuals = measured.points - model.points(vector, measured)
    sigma = np.where(is_free, np.sqrt(np.diag(covariance)), np.nan)
    frozen = tuple(name for name, free in zip(NAMES, is_free, strict=True) if not free)
    return ArmFit(
        errors_of(vector),
        vector,
        sigma,
        covariance,
        frozen,
        outliers,
        residuals,
        held_out,
        noise,
        values,
    )


def misfits(arm: CellArm, measured: Measurements) -> FloatArray:
    """How far each point is from where most of them put it, (n,) m.

    Base and joint 3 alone are fitted, with a robust loss: few enough for one wrong point of eight
    to stand out.

    Raises:
        CalibrationError: the points are of no use at all, as in `fit_arm`.
    """
    measured.check()
    model, free = ErrorModel(arm), np.zeros(len(NAMES), dtype=np.bool_)
    free[BASE_ROTATION] = free[BASE_TRANSLATION] = free[INSERTION] = True
    vector = _solve(model, _registered(model, arm, measured), free, measured, "cauchy")
    return np.asarray(
        np.linalg.norm(measured.points - model.points(vector, measured), axis=1), dtype=np.float64
    )


def _registered(model: ErrorModel, arm: CellArm, measured: Measurements) -> FloatArray:
    """A first vector: the base alone, registered in closed form."""
    start = np.zeros(len(NAMES))
    nominal = model.points(start, measured)
    found = register(nominal, measured.points)
    # T T_task_base = moved base: its rotation in base axes, its shift in task axes
    T0 = np.array(arm.T_task_base)
    moved = found.T @ T0
    start[BASE_ROTATION] = pin.log3(T0[:3, :3].T @ moved[:3, :3])
    start[BASE_TRANSLATION] = moved[:3, 3] - T0[:3, 3]
    turn = float(np.linalg.norm(start[BASE_ROTATION]))
    shift = float(np.linalg.norm(start[BASE_TRANSLATION]))
    if found.rms_m > WORST_RMS_M:
        raise CalibrationError(
            f"no rigid move brings the points of {arm.name} together (rms "
            f"{found.rms_m * 1e3:.1f} mm); check that the points are this arm's, in order"
        )
    if turn > FARTHEST_TURN_RAD or shift > FARTHEST_M:
        raise CalibrationError(
            f"the points would turn the base of {arm.name} by {math.degrees(turn):.0f} degrees and "
            f"move it by {shift * 1e3:.0f} mm; they are in another frame, of the other arm, or the "
            "cell's file is not this cell's"
        )
    return start


def _seen(
    model: ErrorModel, vector: FloatArray, measured: Measurements
) -> tuple[npt.NDArray[np.bool_], FloatArray]:
    """Which parameters the data can tell, and the singular values that say so."""
    _, J = model.linearised(vector, measured)
    scaled = J.reshape(-1, len(NAMES)) * (USUAL / NOISE_M)
    ranks = np.array([parameter.rank for parameter in PARAMETERS])
    free: npt.NDArray[np.bool_] = np.abs(scaled).max(axis=0) > 0.0
    values = np.asarray(np.linalg.svd(scaled, compute_uv=False), dtype=np.float64)
    most = int(3 * len(measured) / ROWS_PER_PARAMETER)
    while free.any():
        _, s, Vt = np.linalg.svd(scaled[:, free], full_matrices=True)
        s = np.pad(s, (0, len(Vt) - len(s)))
        if s[-1] >= BLIND and free.sum() <= most:
            break
        direction = np.zeros(len(NAMES))
        direction[free] = np.abs(Vt[-1]) if s[-1] < BLIND else 1.0
        candidates = direction > 0.2 * direction.max()
        free[int(np.argmax(np.where(candidates, ranks + direction / 2.0, -1.0)))] = False
    if not free[BASE_TRANSLATION].all() or not free[BASE_ROTATION].all():
        raise CalibrationError(
            "the points do not even fix the arm's base; spread them over the workspace, in height "
            "too, and measure each pose once"
        )
    return free, values


def _robust(
    model: ErrorModel, start: FloatArray, free: npt.NDArray[np.bool_], measured: Measurements
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """The fit to all rows but those that do not fit the rest; and which those are."""
    vector = _solve(model, start, free, measured, "cauchy")
    outliers = np.zeros(len(measured), dtype=np.bool_)
    for _ in range(4):
        distances = np.linalg.norm(measured.points - model.points(vector, measured), axis=1)
        scale = max(float(np.median(distances[~outliers])) / 1.5382, 1e-6)
        found = distances > GATE * math.sqrt(3.0) / 1.5382 * scale
        found &= distances > 1e-5
        if 3 * (~found).sum() < ROWS_PER_PARAMETER * free.sum():
            raise CalibrationError(
                f"only {(~found).sum()} of {len(measured)} points fit together; measure again"
            )
        clean = measured.chosen(~found)
        noise = _spread(model, vector, free, clean)[0]
        vector = _solve(model, vector, free, clean, "linear", noise)
        if (found == outliers).all():
            break
        outliers = found
    return vector, outliers


def _solve(
    model: ErrorModel,
    start: FloatArray,
    free: npt.NDArray[np.bool_],
    measured: Measurements,
    loss: str,
    noise_m: float = NOISE_M,
) -> FloatArray:
    """Nonlinear least squares over the free parameters, in units of their usual size.

    The usual sizes are data, too: the result is the most likely one for parameters that are spread
    by them and coordinates that are spread by `noise_m`. Few points gain by it, many do not notice.
    """
    usual = USUAL[free]

    def spread(x: FloatArray) -> FloatArray:
        full = start.copy()
        full[free] = x * usual
        return full

    def residuals(x: FloatArray) -> FloatArray:
        r = ((model.points(spread(x), measured) - measured.points) / NOISE_M).ravel()
        return np.concatenate([r, x * (noise_m / NOISE_M)])

    def jacobian(x: FloatArray) -> FloatArray:
        _, J = model.linearised(spread(x), measured)
        A = J.reshape(-1, len(NAMES))[:, free] * (usual / NOISE_M)
        return np.vstack([A, np.eye(len(x)) * (noise_m / NOISE_M)])

    found = least_squares(
        residuals, start[free] / usual, jacobian, loss=loss, f_scale=3.0, x_scale=1.0, method="trf"
    )
    return spread(found.x)


def _spread(
    model: ErrorModel, vector: FloatArray, free: npt.NDArray[np.bool_], clean: Measurements
) -> tuple[float, FloatArray]:
    """Noise of a coordinate and covariance of the parameters.

    What is frozen at 0 without being 0 pulls at the others; its usual size goes into their
    covariance ("consider covariance", B. D. Tapley et al., Statistical Orbit Determination, 2004).
    """
    points, J = model.linearised(vector, clean)
    r = (clean.points - points).ravel()
    scaled = J.reshape(-1, len(NAMES))[:, free] * USUAL[free]
    variance, unit = NOISE_M**2, np.eye(int(free.sum()))
    inverse: FloatArray = unit
    for _ in range(ROUNDS):  # how many parameters the data have fixed depends on their noise
        inverse = np.asarray(np.linalg.inv(scaled.T @ scaled + variance * unit), dtype=np.float64)
        fixed = float(np.einsum("ij,ji->", inverse, scaled.T @ scaled))
        variance = float(r @ r) / max(r.size - fixed, 1.0)
    blind = ~free & np.array([not parameter.told_by for parameter in PARAMETERS])
    leak = inverse @ scaled.T @ (J.reshape(-1, len(NAMES))[:, blind] * USUAL[blind])
    covariance = np.zeros((len(NAMES), len(NAMES)))
    covariance[np.ix_(free, free)] = (variance * inverse + leak @ leak.T) * np.outer(
        USUAL[free], USUAL[free]
    )
    return math.sqrt(variance), covariance


def _held_out(
    model: ErrorModel,
    vector: FloatArray,
    free: npt.NDArray[np.bool_],
    clean: Measurements,
    noise_m: float,
    seed: int,
) -> FloatArray:
    """Distances of rows from fits that have not seen them, (m,) m."""
    n = len(clean)
    order = np.random.default_rng(seed).permutation(n)
    folds = [order[: int(HELD_OUT * n)]] if n >= FEWEST_TO_SPLIT else [[i] for i in order]
    distances = []
    for fold in folds:
        seen = np.ones(n, dtype=np.bool_)
        seen[fold] = False
        found = _solve(model, vector, free, clean.chosen(seen), "linear", noise_m)
        rest = clean.chosen(~seen)
        distances.append(np.linalg.norm(rest.points - model.points(found, rest), axis=1))
    return np.concatenate(distances)
