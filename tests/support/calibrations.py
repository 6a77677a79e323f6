"""A calibration of the simulated cell, to be judged and spoiled."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any

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


def write_fresh(path: Path, cell: CellDescription, age_s: float = 0.0) -> Path:
    """A calibration that was made `age_s` seconds ago."""
    created = datetime.datetime.now(datetime.UTC) - datetime.timedelta(seconds=age_s)
    return write_calibration(path, calibration_of(cell, created=created))
