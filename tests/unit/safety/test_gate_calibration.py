"""S27: age and residual of a calibration against the ceilings."""

import math

import pytest
from calibrations import CREATED, calibration_of
from gate_rig import CELL

from viskill_deploy.core.types import Action
from viskill_deploy.safety import ceilings
from viskill_deploy.safety.calibration import (
    calibration_figures,
    calibration_margin,
    judge_calibration,
)

MADE = CREATED.timestamp()
DAY = 86400.0


def with_residuals(*residuals: float):
    calibration = calibration_of(CELL)
    arms = [
        arm.model_copy(update={"residual_rms_m": r})
        for arm, r in zip(calibration.arms, residuals, strict=True)
    ]
    return calibration.model_copy(update={"arms": tuple(arms)})


def test_s27_the_ceilings_are_30_days_and_a_millimetre_and_a_half():
    assert ceilings.MAX_CALIBRATION_AGE_S == 30 * DAY
    assert ceilings.MAX_CALIBRATION_RESIDUAL_M == 0.0015


@pytest.mark.parametrize("age", [0.0, DAY, 30 * DAY, -30 * DAY, -1.0])
def test_s27_a_young_calibration_passes(age):
    assert list(judge_calibration(calibration_of(CELL), MADE + age)) == []


@pytest.mark.parametrize("age", [30 * DAY + 1.0, -30 * DAY - 1.0, 365 * DAY, math.inf, math.nan])
def test_s27_an_old_one_or_one_from_the_future_is_refused(age):
    (verdict,) = judge_calibration(calibration_of(CELL), MADE + age)
    told = verdict.rule, verdict.action, verdict.arm, verdict.joint
    assert told == ("S27", Action.HOLD, -1, -1)
    assert verdict.limit == 30 * DAY
    assert math.isnan(verdict.value) if math.isnan(age) else verdict.value == abs(age)


@pytest.mark.parametrize("arm", [0, 1])
@pytest.mark.parametrize("residual", [0.0015000001, 0.015, math.inf, math.nan])
def test_s27_a_coarse_one_is_refused_arm_by_arm(arm, residual):
    residuals = [0.0015, 0.0015]
    residuals[arm] = residual
    (verdict,) = judge_calibration(with_residuals(*residuals), MADE)
    assert (verdict.action, verdict.arm, verdict.limit) == (Action.HOLD, arm, 0.0015)


def test_s27_the_margin_is_that_of_the_tightest_figure():
    assert calibration_margin(with_residuals(0.0003, 0.0006), MADE) == pytest.approx(0.6)
    assert calibration_margin(with_residuals(0.0, 0.0), MADE + 12 * DAY) == pytest.approx(0.6)
    assert calibration_margin(with_residuals(0.0, 0.003), MADE) == pytest.approx(-1.0)


@pytest.mark.parametrize("age", [365 * DAY, -365 * DAY, math.nan])
def test_s27_that_of_simulated_arms_does_not_age_but_may_be_coarse(age):
    young = calibration_of(CELL, simulated=True)
    assert calibration_figures(young, MADE + age)[0][0] == 0.0
    assert list(judge_calibration(young, MADE + age)) == []
    assert calibration_margin(young, MADE + age) == pytest.approx(0.6)
    coarse = with_residuals(0.0016, 0.0).model_copy(update={"simulated": True})
    (verdict,) = judge_calibration(coarse, MADE + age)
    assert verdict.arm == 0
