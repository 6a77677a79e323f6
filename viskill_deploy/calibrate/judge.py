"""What a fit means: residuals before and after, the delay's curve, and errors to expect at work."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from viskill_deploy.calibrate.error_model import ErrorModel
from viskill_deploy.calibrate.fit import ArmFit
from viskill_deploy.calibrate.measurements import Measurements
from viskill_deploy.calibrate.parameters import DELAY, NAMES, PARAMETERS, USUAL
from viskill_deploy.core.description import CellArm, CellDescription
from viskill_deploy.core.types import FloatArray
from viskill_deploy.kinematics.closed_form import inverse_batch
from viskill_deploy.motion.resolve import base_poses
from viskill_deploy.motion.waypoints import start_waypoint

DELAYS_S = np.linspace(-0.02, 0.1, 61)
"""Delays at which the residual is shown."""


@dataclass(frozen=True)
class Judged:
    """One arm's calibration, for people.

    Attributes:
        name: the arm.
        points: measured points, task frame, (n, 3) m.
        before: measured minus nominal points, (n, 3) m.
        after: measured minus fitted points, (n, 3) m.
        is_outlier: rows that were left out, (n,).
        held_out_m: distances of rows from fits that have not seen them.
        singular_values: of the information, see `fit.ArmFit`.
        delay_s, delay_rms_m: root mean square residual of the moving rows over the delay; empty
            when no row was measured on the move.
        parameters: name, value and sigma (NaN: the data do not tell).
        places, expected_m: points of the workspace, (k, 3), and the tip's standard deviation there.
    """

    name: str
    points: FloatArray
    before: FloatArray
    after: FloatArray
    is_outlier: npt.NDArray[np.bool_]
    held_out_m: FloatArray
    singular_values: FloatArray
    delay_s: FloatArray
    delay_rms_m: FloatArray
    parameters: tuple[tuple[str, float, float], ...]
    places: FloatArray
    expected_m: FloatArray


def judge(cell: CellDescription, index: int, measured: Measurements, fit: ArmFit) -> Judged:
    """Everything that a person wants to see of an arm's fit."""
    arm = cell.arms[index]
    model = ErrorModel(arm)
    nominal = model.points(np.zeros(len(NAMES)), measured)
    is_moving = measured.speeds.any(axis=1) & ~fit.is_outlier
    delays = DELAYS_S if is_moving.any() else np.zeros(0)
    moving = measured.chosen(is_moving)
    curve = [_rms(model, fit, moving, delay) for delay in delays]
    places = work_places(cell, arm)
    values, sigmas = fit.vector.tolist(), fit.sigma.tolist()
    return Judged(
        arm.name,
        measured.points,
        measured.points - nominal,
        fit.residuals,
        fit.is_outlier,
        fit.held_out_m,
        fit.singular_values,
        delays,
        np.array(curve),
        tuple(zip(NAMES, values, sigmas, strict=True)),
        places,
        expected_errors(cell, index, fit, places),
    )


def work_places(cell: CellDescription, arm: CellArm) -> FloatArray:
    """Where the work is, (k, 3): the board's pegs in the arm's workspace, else its corners."""
    low, high = np.array(arm.entry.workspace_lower_m), np.array(arm.entry.workspace_upper_m)
    board = cell.file.board
    if board is not None:
        tops = np.array([(x, y, board.peg_height_m) for x, y in board.peg_xy_m])
        inside = ((tops >= low) & (tops <= high)).all(axis=1)
        if inside.any():
            return np.asarray(tops[inside])
    xy = [(x, y) for x in (low[0], high[0]) for y in (low[1], high[1])]
    return np.array([(x, y, (low[2] + high[2]) / 2.0) for x, y in xy])


def expected_errors(
    cell: CellDescription, index: int, fit: ArmFit, places: FloatArray
) -> FloatArray:
    """Standard deviation of the tip's distance at places, in the start orientation, (k,) m.

    What the data do not tell goes in with its usual size; NaN where the arm does not reach.
    """
    arm = cell.arms[index]
    start = start_waypoint(cell).T_task_tip[index]
    poses = np.tile(start, (len(places), 1, 1))
    poses[:, :3, 3] = places
    seed = inverse_batch(arm.arm, base_poses(cell, index, start[None]), np.zeros(6))[0][0]
    q, reached = inverse_batch(arm.arm, base_poses(cell, index, poses), seed)
    n = len(places)
    rows = Measurements(
        np.arange(float(n)),
        np.where(reached[:, None], q, seed),
        np.zeros((n, 6)),
        np.ones((n, 3)),
        np.zeros((n, 3)),
    )
    _, J = ErrorModel(arm).linearised(fit.vector, rows)
    unseen = np.isnan(fit.sigma) & np.array([not p.told_by for p in PARAMETERS])
    covariance = fit.covariance + np.diag(np.where(unseen, USUAL, 0.0) ** 2)
    variances = np.einsum("nai,ij,naj->n", J, covariance, J, optimize=True)
    return np.where(reached, np.sqrt(variances), np.nan)


def _rms(model: ErrorModel, fit: ArmFit, moving: Measurements, delay: float) -> float:
    vector = fit.vector.copy()
    vector[DELAY] = delay
    residuals = moving.points - model.points(vector, moving)
    return float(np.sqrt((residuals**2).sum(axis=1).mean()))
