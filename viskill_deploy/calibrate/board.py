"""The board in the task frame of a calibration, and a calibration whose board was moved."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pinocchio as pin

from viskill_deploy.calibrate import measurements
from viskill_deploy.calibrate.fit import FARTHEST_M, FARTHEST_TURN_RAD
from viskill_deploy.calibrate.pose_fit import PoseFit, fit_pose
from viskill_deploy.core.calibration_files import ArmCalibration, CalibrationFile
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.motion.resolve import task_poses


def jaw_ends(cell: CellDescription, index: int, q: FloatArray, point_m: float) -> FloatArray:
    """Where a calibrated arm has the end of its closed jaw, task frame, (n, 3) m.

    Nobody knows which way a wrist came that was moved by hand: its play is taken to be centred.
    """
    arm = cell.arms[index]
    true = q.copy()
    true[:, 3:6] += arm.cables.error(q, np.zeros((len(q), 3)))
    T = task_poses(cell, index, true)
    return np.asarray(T[:, :3, 3] + point_m * T[:, :3, 2])


def arm_error_m(calibration: CalibrationFile) -> float:
    """What the calibration of the worst arm leaves, standard deviation of a coordinate, m."""
    return max(arm.residual_rms_m for arm in calibration.arms) / float(np.sqrt(3.0))


def touched_board(cell: CellDescription, arm_m: float, folder: Path) -> PoseFit:
    """Where the board is, from touches of its points by calibrated arms.

    Args:
        cell: calibrated.
        arm_m: what the calibration leaves, see `arm_error_m`.
        folder: touches of one arm at least, `<arm>.csv`.

    Raises:
        CalibrationError: too few points, or points that are not the board's.
    """
    points, seen = list[FloatArray](), list[FloatArray]()
    for index, arm in enumerate(cell.arms):
        path = folder / f"{arm.name}.csv"
        if path.exists():
            m = measurements.load(path, arm=arm)
            m.check()
            points.append(m.points)
            seen.append(jaw_ends(cell, index, m.joints, m.point_m))
    if not points:
        raise CalibrationError(
            f"{folder}: holds no touches; measure with `viskill calibrate collect {folder} "
            "--source touch`"
        )
    fit = fit_pose(np.concatenate(points), np.concatenate(seen), arm_m)
    shift = float(np.linalg.norm(fit.T[:3, 3]))
    if fit.turn_rad > FARTHEST_TURN_RAD or shift > FARTHEST_M:
        raise CalibrationError(
            f"the board would be turned by {np.degrees(fit.turn_rad):.0f} degrees and moved by "
            f"{1e3 * shift:.0f} mm; the touches are in another frame or of another cell"
        )
    return fit


def on_moved_board(calibration: CalibrationFile, board: PoseFit, folder: Path) -> CalibrationFile:
    """The calibration whose task frame is that of the board where it is now.

    Arms, joints and cables are as they were measured, and so is their date.
    """
    rms = float(np.sqrt(np.nanmean(board.held_out_m[board.is_inlier] ** 2)))
    files = [folder / f"{arm.name}.csv" for arm in calibration.arms]
    data = b"".join(path.read_bytes() for path in files if path.exists())
    return calibration.model_copy(
        update={
            "arms": tuple(_moved(arm, board, rms) for arm in calibration.arms),
            "method": f"{calibration.method}; board by touch",
            "data_sha256": hashlib.sha256(data).hexdigest(),
        }
    )


def _moved(arm: ArmCalibration, board: PoseFit, rms_m: float) -> ArmCalibration:
    T = np.linalg.inv(board.T) @ np.array(arm.T_task_base)
    R = T[:3, :3]
    # how the base moves in the board's frame with the board's pose, and how it turns in its own
    B = board.T[:3, :3].T
    shift = B @ np.hstack([np.eye(3), -pin.skew(np.array(arm.T_task_base)[:3, 3] - board.T[:3, 3])])
    turn = R.T @ B
    spreads = {
        "base_translation_{}_m": np.diag(shift @ board.covariance @ shift.T),
        "base_rotation_{}_rad": np.diag(turn @ board.covariance[3:, 3:] @ turn.T),
    }
    sigma = dict(arm.sigma)
    for name, variances in spreads.items():
        for axis, variance in zip("xyz", variances.tolist(), strict=True):
            key = name.format(axis)
            sigma[key] = float(np.hypot(sigma.get(key, 0.0), np.sqrt(variance)))
    rows = tuple(tuple(row) for row in T.tolist())
    return arm.model_copy(
        update={
            "T_task_base": rows,
            "sigma": sigma,
            "residual_rms_m": max(arm.residual_rms_m, rms_m),
        }
    )
