"""Actions to waypoints: the rule that learning and runtime share."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from viskill_deploy.core.description import load_cell, rpy_matrix
from viskill_deploy.motion.waypoints import (
    BASE_TOLERANCE_M,
    WORKSPACE_INSET_M,
    ActionSpec,
    apply_action,
    downward_pose,
    pitch_of,
    pitched_pose,
    start_waypoint,
    yaw_of,
)

CELL = load_cell("bipegtransfer")
SPEC = ActionSpec()
START = start_waypoint(CELL)
STILL = np.array([0.0, 0.0, 0.0, 0.0, -1.0] * 2)


def act(action: np.ndarray, spec: ActionSpec = SPEC, measured: object = None):
    return apply_action(START, action, measured or START.T_task_tip, CELL, spec)


def test_the_start_is_the_cells_and_its_jaws_are_closed() -> None:
    for pose, entry in zip(START.T_task_tip, (arm.entry for arm in CELL.arms), strict=True):
        np.testing.assert_allclose(pose[:3, 3], entry.start_position_m)
        assert yaw_of(pose) == pytest.approx(entry.start_yaw_rad)
    assert START.jaw == tuple(arm.arm.jaw.grip_angle_rad for arm in CELL.arms)


@given(st.floats(-3.1, 3.1))
def test_a_downward_pose_is_a_proper_pose_with_that_yaw(yaw: float) -> None:
    T = downward_pose((0.01, 0.02, 0.03), yaw)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(T[:3, 2], [0, 0, -1])
    assert yaw_of(T) == pytest.approx(yaw)


@settings(deadline=None)
@given(st.floats(-1.5, 1.5))
def test_a_pitched_pose_turns_about_y_and_keeps_roll_and_yaw_of_the_eef(pitch: float) -> None:
    T = pitched_pose((0.01, 0.02, 0.03), pitch)
    R_eef = np.column_stack([-T[:3, 1], T[:3, 2], -T[:3, 0]])
    expected = rpy_matrix(math.radians(-15), pitch, -math.pi)
    np.testing.assert_allclose(R_eef, expected, atol=1e-12)
    np.testing.assert_allclose(T[:3, 3], (0.01, 0.02, 0.03))
    assert pitch_of(T) == pytest.approx(pitch)


def test_a_rotation_unit_of_an_arm_in_pitch_mode_is_fifteen_degrees_up_to_a_quarter_turn() -> None:
    spec, poses = ActionSpec(rotation=("pitch", "yaw")), START.T_task_tip
    waypoint = replace(START, T_task_tip=(pitched_pose((0, 0.03, 0.05), 0.3), poses[1]))
    action = STILL.copy()
    action[[3, 8]] = 1.0
    seen = []
    for _ in range(6):
        waypoint = apply_action(waypoint, action, waypoint.T_task_tip, CELL, spec)
        seen.append(pitch_of(waypoint.T_task_tip[0]))
    turned = [0.3 + math.radians(15) * (i + 1) for i in range(4)]
    assert seen == pytest.approx([*turned, math.pi / 2, math.pi / 2])
    assert yaw_of(waypoint.T_task_tip[1]) == pytest.approx(math.radians(90 + 6 * 30 - 360))


def test_a_unit_on_one_axis_is_shortened_to_nine_millimetres() -> None:
    action = STILL.copy()
    action[2] = -1.0
    moved = act(action).T_task_tip[0][:3, 3] - START.T_task_tip[0][:3, 3]
    np.testing.assert_allclose(moved, [0, 0, -0.009], atol=1e-12)


def test_a_small_displacement_is_ten_millimetres_a_unit() -> None:
    action = STILL.copy()
    action[5:8] = [0.3, 0.2, -0.5]
    moved = act(action).T_task_tip[1][:3, 3] - START.T_task_tip[1][:3, 3]
    np.testing.assert_allclose(moved, [0.003, 0.002, -0.005], atol=1e-12)


def test_a_rotation_unit_is_thirty_degrees_of_yaw() -> None:
    action = STILL.copy()
    action[[3, 8]] = [1.0, -0.5]
    yaws = [yaw_of(T) for T in act(action).T_task_tip]
    assert yaws == pytest.approx([math.radians(120), math.radians(75)])


def test_the_jaw_closes_below_zero_and_opens_from_zero_on() -> None:
    action = STILL.copy()
    action[[4, 9]] = [-1e-9, 0.0]
    assert act(action).jaw == (CELL.arms[0].arm.jaw.grip_angle_rad, SPEC.jaw_open_rad)


@given(st.lists(st.floats(-50, 50), min_size=10, max_size=10))
def test_no_action_leaves_the_workspace_or_is_longer_than_allowed(numbers: list[float]) -> None:
    waypoint = act(np.array(numbers))
    for pose, before, arm in zip(
        waypoint.T_task_tip, START.T_task_tip, (a.entry for a in CELL.arms), strict=True
    ):
        low = np.array(arm.workspace_lower_m) + WORKSPACE_INSET_M
        high = np.array(arm.workspace_upper_m) - WORKSPACE_INSET_M
        assert (pose[:3, 3] >= low - 1e-12).all()
        assert (pose[:3, 3] <= high + 1e-12).all()
        assert np.linalg.norm(pose[:3, 3] - before[:3, 3]) <= SPEC.max_displacement_m + 1e-9


def test_actions_build_on_the_setpoint_but_never_run_away_from_the_arm() -> None:
    seen = [T.copy() for T in START.T_task_tip]
    seen[0][2, 3] -= 0.02
    seen[1][2, 3] -= 0.002
    first, second = act(STILL, measured=seen).T_task_tip
    assert first[2, 3] == pytest.approx(seen[0][2, 3] + BASE_TOLERANCE_M)
    assert second[2, 3] == pytest.approx(START.T_task_tip[1][2, 3])


def test_official_policies_build_on_the_measured_tip() -> None:
    seen = [T.copy() for T in START.T_task_tip]
    seen[0][2, 3] -= 0.002
    first, _ = act(STILL, ActionSpec(reference="measured"), seen).T_task_tip
    assert first[2, 3] == pytest.approx(seen[0][2, 3])
