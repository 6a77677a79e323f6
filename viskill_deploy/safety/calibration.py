"""S27: a calibration that is too old or too coarse does not arm a cell."""

from __future__ import annotations

from collections.abc import Iterator

from viskill_deploy.core.calibration_files import CalibrationFile
from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety import ceilings

ID = "S27"


def calibration_figures(
    calibration: CalibrationFile, wall_s: float
) -> tuple[tuple[float, float], ...]:
    """Value and limit of the calibration's age, s, and then of every arm's residual, m.

    Args:
        calibration: belongs to the cell.
        wall_s: Unix time, s. Setting the clock back makes nothing young: a calibration from the
            future is as bad as an old one. One of simulated arms does not age.
    """
    age = 0.0 if calibration.simulated else abs(wall_s - calibration.created.timestamp())
    return (
        (age, ceilings.MAX_CALIBRATION_AGE_S),
        *((arm.residual_rms_m, ceilings.MAX_CALIBRATION_RESIDUAL_M) for arm in calibration.arms),
    )


def calibration_margin(calibration: CalibrationFile, wall_s: float) -> float:
    """What is left of the tightest of them, as a part of its limit."""
    return min(1.0 - value / limit for value, limit in calibration_figures(calibration, wall_s))


def judge_calibration(calibration: CalibrationFile, wall_s: float) -> Iterator[Verdict]:
    """Why the cell may not be armed with it: arm -1 for the age."""
    for arm, (value, limit) in enumerate(calibration_figures(calibration, wall_s), start=-1):
        if not value <= limit:
            yield Verdict(ID, Action.HOLD, arm, -1, value, limit)
