"""Fits as the calibration file of a cell."""

from __future__ import annotations

import datetime
import hashlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from viskill_deploy.calibrate.fit import ArmFit
from viskill_deploy.calibrate.parameters import NAMES
from viskill_deploy.calibrate.port import Port
from viskill_deploy.core.arm_errors import with_errors
from viskill_deploy.core.calibration_files import ArmCalibration, CalibrationFile, is_simulated
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import CalibrationError


def calibration_file(
    cell: CellDescription,
    fits: Mapping[str, ArmFit],
    files: Mapping[str, Path],
    created: datetime.datetime,
    method: str,
    ports: Mapping[str, Port] | None = None,
) -> CalibrationFile:
    """What was found, ready to be written.

    Args:
        cell: as its files have it.
        fits: of every arm, by name.
        files: the measurements of every arm.
        created: when they were taken.
        method: how, for people.
        ports: of arms whose shaft was measured, in their base frames.

    Raises:
        CalibrationError: an arm was not fitted.
    """
    missing = [arm.name for arm in cell.arms if arm.name not in fits]
    if missing:
        raise CalibrationError(f"nothing was fitted for {', '.join(missing)}; measure all arms")
    really = with_errors(cell, {name: fit.errors for name, fit in fits.items()})
    arms = []
    for arm, placed in zip(cell.arms, really.arms, strict=True):
        fit, port = fits[arm.name], (ports or {}).get(arm.name)
        rows = placed.T_task_base.tolist()
        arms.append(
            ArmCalibration.model_validate(
                {
                    "name": arm.name,
                    "robot": arm.entry.robot,
                    "serial": arm.entry.serial,
                    "tool": arm.entry.tool,
                    "T_task_base": rows,
                    "port_in_base_m": None if port is None else port.position.tolist(),
                    "joint_offset": fit.errors.joint_offset,
                    "tool_length_m": fit.errors.tool_length_m,
                    "backlash_rad": fit.errors.cables.backlash_rad,
                    "coupling": fit.errors.cables.coupling,
                    "delay_s": fit.errors.delay_s,
                    "sigma": _sigmas(fit) | ({} if port is None else _port_sigmas(port)),
                    "residual_rms_m": float(np.sqrt((fit.held_out_m**2).mean())),
                    "samples": int((~fit.is_outlier).sum()),
                }
            )
        )
    digest = hashlib.sha256(b"".join(files[arm.name].read_bytes() for arm in cell.arms))
    return CalibrationFile.model_validate(
        {
            "schema": 1,
            "cell": cell.name,
            "created": created,
            "method": method,
            "arms": arms,
            "data_sha256": digest.hexdigest(),
            "simulated": is_simulated(cell),
        }
    )


def _sigmas(fit: ArmFit) -> dict[str, float]:
    return {
        name: float(sigma)
        for name, sigma in zip(NAMES, fit.sigma, strict=True)
        if np.isfinite(sigma)
    }


def _port_sigmas(port: Port) -> dict[str, float]:
    spread = np.sqrt(np.diag(port.covariance)).tolist()
    return {f"port_{axis}_m": sigma for axis, sigma in zip("xyz", spread, strict=True)}
