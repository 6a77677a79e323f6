"""A calibration of the simulated cell, to be judged and spoiled."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from viskill_deploy.core.arm_errors import ArmErrors, with_errors
from viskill_deploy.core.calibration_files import CalibrationFile, write_calibration
from viskill_deploy.core.description import CellDescription

CREATED = datetime.datetime(2026, 3, 1, 12, 0, tzinfo=datetime.UTC)


def calibration_of(cell: CellDescription, /, **changes: Any) -> CalibrationFile:
    """One that leaves the arms where the cell's file has them; `changes` are of its entries."""
    arms = [
        {
            "name": arm.name,
            "robot": arm.entry.robot,
            "serial": arm.entry.serial,
            "tool": arm.entry.tool,
            "T_task_base": arm.T_task_base.tolist(),
            "residual_rms_m": 0.0006,
            "samples": 120,
        }
        for arm in cell.arms
    ]
    content = {
        "schema": 1,
        "cell": cell.name,
        "created": CREATED,
        "method": "points",
        "arms": arms,
        "data_sha256": "0" * 64,
    }
    return CalibrationFile.model_validate(content | changes)


def exact_calibration(cell: CellDescription, truth: Sequence[ArmErrors]) -> CalibrationFile:
    """What a perfect calibration of arms with these errors would write."""
    names = [arm.name for arm in cell.arms]
    really = with_errors(cell, dict(zip(names, truth, strict=True)))
    found = calibration_of(really)
    arms = tuple(
        entry.model_copy(
            update={
                "joint_offset": errors.joint_offset,
                "tool_length_m": errors.tool_length_m,
                "backlash_rad": errors.cables.backlash_rad,
                "coupling": errors.cables.coupling,
            }
        )
        for entry, errors in zip(found.arms, truth, strict=True)
    )
    return found.model_copy(update={"arms": arms})


def write_fresh(path: Path, cell: CellDescription, age_s: float = 0.0) -> Path:
    """A calibration that was made `age_s` seconds ago."""
    created = datetime.datetime.now(datetime.UTC) - datetime.timedelta(seconds=age_s)
    return write_calibration(path, calibration_of(cell, created=created))
