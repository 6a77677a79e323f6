from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from measured_arm import TYPICAL, cell_arm, measured, poses, true_points, with_points

from viskill_deploy.calibrate.error_model import ErrorModel
from viskill_deploy.calibrate.fit import ArmFit, fit_arm
from viskill_deploy.calibrate.measurements import Measurements
from viskill_deploy.calibrate.parameters import NAMES, USUAL, errors_of, vector_of
from viskill_deploy.core.arm_errors import ArmErrors, with_errors
from viskill_deploy.core.cables import STIFF
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.kinematics.model import forward_batch

ARM = cell_arm()
BLIND_AT_PIVOT = {
    "offset_yaw_rad",
    "tool_length_m",
    "offset_wrist_yaw_rad",
    "backlash_wrist_yaw_rad",
    "coupling_wrist_yaw_by_roll",
    "coupling_wrist_yaw_by_wrist_pitch",
    "coupling_wrist_yaw_by_wrist_yaw",
}


def _tip_errors(fit: ArmFit, truth: ArmErrors) -> np.ndarray:
    """Distances at 400 poses that were not measured, m."""
    fresh = poses(400, np.random.default_rng(99), moving=0.0)
    there = ErrorModel(ARM).points(fit.vector, fresh)
    return np.asarray(np.linalg.norm(there - true_points(ARM, truth, fresh), axis=1))


def test_the_vector_and_its_names_go_together() -> None:
    vector = np.arange(27.0)
    np.testing.assert_array_equal(vector_of(errors_of(vector)), vector)
    assert len(NAMES) == len(set(NAMES)) == 27


def test_the_model_follows_the_definitions() -> None:
    rng = np.random.default_rng(0)
    m = with_points(poses(30, rng), np.zeros((30, 3)))
    m = replace(m, point_m=0.0102)
    vector = rng.normal(0, 1, 27) * USUAL
    np.testing.assert_allclose(
        ErrorModel(ARM).points(vector, m), true_points(ARM, errors_of(vector), m), atol=1e-12
    )


def test_a_point_further_out_lies_along_the_turned_tip() -> None:
    rng = np.random.default_rng(2)
    m, model, vector = poses(20, rng), ErrorModel(ARM), rng.normal(0, 1, 27) * USUAL
    pivot, beyond = (model.points(vector, replace(m, point_m=along)) for along in (0.0, 0.01))
    R = model.rotations(vector, m)
    np.testing.assert_allclose(R[:, :, 2], (beyond - pivot) / 0.01, atol=1e-9)
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (20, 1, 1)), atol=1e-12)


def test_the_jacobian_is_the_central_difference() -> None:
    rng = np.random.default_rng(1)
    m, model = poses(10, rng), ErrorModel(ARM)
    vector = rng.normal(0, 1, 27) * USUAL
    _, J = model.linearised(vector, m)
    for k in range(27):
        step = np.zeros(27)
        step[k] = 1e-6
        difference = (model.points(vector + step, m) - model.points(vector - step, m)) / 2e-6
        np.testing.assert_allclose(J[:, :, k], difference, atol=1e-8, err_msg=NAMES[k])


def test_a_typical_arm_is_found_through_noise_and_outliers() -> None:
    m, wrong = measured(ARM, TYPICAL, 200, seed=0, wrong=0.1)
    fit = fit_arm(ARM, m)
    errors = _tip_errors(fit, TYPICAL)
    assert np.median(errors) < 2e-4
    assert np.quantile(errors, 0.95) < 4e-4
    assert set(fit.frozen) - {"coupling_roll_by_wrist_yaw"} == BLIND_AT_PIVOT
    assert abs(fit.errors.joint_offset[2] - TYPICAL.joint_offset[2]) < 2e-4
    assert abs(fit.errors.delay_s - TYPICAL.delay_s) < 2e-3
    assert (fit.is_outlier[wrong]).mean() > 0.95
    assert (fit.is_outlier[~wrong]).mean() < 0.03
    assert fit.noise_m == pytest.approx(2e-4, rel=0.15)
    assert np.median(fit.held_out_m) < 4e-4


def test_sigmas_are_honest() -> None:
    scores = []
    for seed in range(6):
        fit = fit_arm(ARM, measured(ARM, TYPICAL, 80, seed=seed)[0])
        z = np.abs(fit.vector - vector_of(TYPICAL)) / fit.sigma
        scores += z[np.isfinite(z)].tolist()
    assert 0.88 <= np.mean(np.array(scores) < 2.0) <= 1.0


def test_an_exact_arm_is_left_as_it_is() -> None:
    fit = fit_arm(ARM, measured(ARM, ArmErrors(), 60, seed=2, noise_m=0.0)[0])
    assert np.abs(fit.vector / USUAL).max() < 1e-6
    assert not fit.is_outlier.any()


def test_ten_touched_points_fix_base_and_insertion_and_freeze_the_wrist() -> None:
    truth = ArmErrors(TYPICAL.base_rotation_rad, TYPICAL.base_translation_m, (0, 0, 0.006, 0, 0, 0))
    fit = fit_arm(ARM, measured(ARM, truth, 10, seed=1)[0])
    assert np.median(_tip_errors(fit, truth)) < 6e-4
    assert "offset_insertion_m" not in fit.frozen
    assert "coupling_roll_by_wrist_yaw" in fit.frozen


def test_points_at_the_jaw_end_show_the_wrist_yaw() -> None:
    truth = ArmErrors(joint_offset=(0, 0, 0, 0, 0, 0.03))
    m = poses(120, np.random.default_rng(0))
    m = replace(m, point_m=0.0102)
    fit = fit_arm(ARM, with_points(m, true_points(ARM, truth, m)))
    assert fit.errors.joint_offset[5] == pytest.approx(0.03, abs=1e-4)


def test_without_turns_and_speeds_backlash_and_delay_are_frozen() -> None:
    m, _ = measured(ARM, ArmErrors(), 100, seed=0)
    still = Measurements(m.stamps, m.joints, np.zeros((100, 6)), np.zeros((100, 3)), m.points)
    frozen = fit_arm(ARM, still).frozen
    assert "delay_s" in frozen
    assert "backlash_roll_rad" in frozen


def _bad(change: Callable[[np.ndarray, np.ndarray], None], n: int = 60) -> Measurements:
    m, _ = measured(ARM, TYPICAL, n, seed=4)
    joints, points = m.joints.copy(), m.points.copy()
    change(joints, points)
    return replace(m, joints=joints, points=points)


def _repeat(joints: np.ndarray, points: np.ndarray) -> None:
    joints[:], points[:] = joints[0], points[0]


def _millimetres(_: np.ndarray, points: np.ndarray) -> None:
    points *= 1e3


def _degrees(joints: np.ndarray, _: np.ndarray) -> None:
    joints[:] = np.rad2deg(joints)


def _insertion_in_mm(joints: np.ndarray, _: np.ndarray) -> None:
    joints[:, 2] *= 1e3


def _some_millimetres(_: np.ndarray, points: np.ndarray) -> None:
    points[40:] *= 1e3


def _some_degrees(joints: np.ndarray, _: np.ndarray) -> None:
    joints[40:] = np.rad2deg(joints[40:])


def _other_frame(_: np.ndarray, points: np.ndarray) -> None:
    points[:] = points[:, [1, 0, 2]] * [1, -1, 1]


def _shuffled(_: np.ndarray, points: np.ndarray) -> None:
    np.random.default_rng(0).shuffle(points)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (_repeat, "one line"),
        (_millimetres, "look like mm"),
        (_degrees, "look"),
        (_insertion_in_mm, "joint 3 is in m"),
        (_some_millimetres, r"row 41 lies .* \(20 such rows\)"),
        (_some_degrees, "look"),
        (_other_frame, "another frame"),
        (_shuffled, "no rigid move"),
    ],
)
def test_bad_data_is_named_never_fitted(
    change: Callable[[np.ndarray, np.ndarray], None], words: str
) -> None:
    with pytest.raises(CalibrationError, match=words):
        fit_arm(ARM, _bad(change))


def test_a_row_that_is_not_finite_is_named() -> None:
    m, _ = measured(ARM, TYPICAL, 20, seed=4)
    points = m.points.copy()
    points[6, 1] = np.nan
    with pytest.raises(CalibrationError, match="row 7 of points"):
        with_points(m, points)


def test_points_of_the_other_arm_are_named() -> None:
    m, _ = measured(cell_arm(1), ArmErrors(), 60, seed=5)
    with pytest.raises(CalibrationError, match="other arm"):
        fit_arm(ARM, m)


def test_too_few_points_are_refused() -> None:
    with pytest.raises(CalibrationError, match="at least 6"):
        fit_arm(ARM, measured(ARM, ArmErrors(), 5, seed=0)[0])


def test_points_in_one_plane_freeze_what_they_hide() -> None:
    rng = np.random.default_rng(0)
    m = poses(400, rng, moving=0.0)
    height = true_points(ARM, ArmErrors(), m)[:, 2]
    flat = m.chosen(np.abs(height - np.median(height)) < 1.5e-3)
    fit = fit_arm(ARM, with_points(flat, true_points(ARM, ArmErrors(), flat)))
    assert np.median(_tip_errors(fit, ArmErrors())) < 1e-4


def test_the_calibrated_cell_says_where_the_tip_is() -> None:
    truth = replace(TYPICAL, cables=STIFF, delay_s=0.0)
    truth = replace(truth, tool_length_m=0.002, joint_offset=(0.01, *truth.joint_offset[1:]))
    described = with_errors(load_cell("bipegtransfer"), {"PSM1": truth}).arms[0]
    m = poses(50, np.random.default_rng(0))
    T = described.T_task_base @ forward_batch(described.arm, m.joints)
    np.testing.assert_allclose(T[:, :3, 3], true_points(ARM, truth, m), atol=1e-12)
    np.testing.assert_array_equal(described.arm.limit(0), ARM.arm.limit(0))


def test_arms_that_are_not_named_stay_as_they_are() -> None:
    cell = load_cell("bipegtransfer")
    assert with_errors(cell, {"PSM1": TYPICAL}).arms[1] is cell.arms[1]


def test_commands_take_the_cables_off() -> None:
    m = poses(50, np.random.default_rng(1))
    command = TYPICAL.cables.reported(m.joints, m.turns)
    there = command[:, 3:] + TYPICAL.cables.error(command, m.turns)
    np.testing.assert_allclose(there, m.joints[:, 3:], atol=1e-7)
    np.testing.assert_array_equal(command[:, :3], m.joints[:, :3])
