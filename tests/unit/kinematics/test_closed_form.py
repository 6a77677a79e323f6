"""The closed form over every instrument, its batch, its branches."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from viskill_deploy.core import data
from viskill_deploy.core.description import load_robot
from viskill_deploy.core.errors import IkError, KinematicsError, NoSolutionError
from viskill_deploy.core.robot_files import ToolFile, read_toml
from viskill_deploy.kinematics.arm import Arm
from viskill_deploy.kinematics.closed_form import (
    BRANCHES,
    TURN,
    PsmGeometry,
    branch_solution,
    inverse_batch,
    nearest_turn,
)

TOOLS = data.names("robots/tools")
ROBOTS = {"Classic": "psm_classic", "Si": "psm_si"}


def arm_with(tool: str) -> Arm:
    """The arm of the tool's generation with the tool in it."""
    file = read_toml(data.find(f"robots/tools/{tool}.toml"), ToolFile)
    return Arm(load_robot(ROBOTS[file.generation], tool))


def test_all_51_instruments_are_there() -> None:
    assert len(TOOLS) == 51


@pytest.mark.parametrize("tool", TOOLS)
def test_every_instrument_goes_round_from_joints_to_pose_to_joints(tool: str) -> None:
    arm = arm_with(tool)
    q = np.random.default_rng(7).uniform(arm.lower, arm.upper, (100, 6))
    poses = arm.forward_batch(q)
    again, ok = arm.inverse_batch(poses, q)
    assert ok.all()
    np.testing.assert_allclose(arm.forward_batch(again), poses, rtol=0, atol=1e-9)
    # Within 3 mm of the remote centre the pose hardly depends on yaw and pitch.
    clear = np.abs(q[:, 2] + arm.description.wrist_offset_m) > 0.003
    np.testing.assert_allclose(again[clear], q[clear], rtol=0, atol=1e-9)


@pytest.mark.parametrize("tool", TOOLS[::10])
def test_scalar_and_batch_agree_on_joints_and_on_refusals(tool: str) -> None:
    arm = arm_with(tool)
    span = 0.15 * (arm.upper - arm.lower)
    q = np.random.default_rng(8).uniform(arm.lower - span, arm.upper + span, (200, 6))
    poses, seeds = arm.forward_batch(q), np.random.default_rng(9).uniform(-4, 4, (200, 6))
    batch, ok = inverse_batch(arm.description, poses, seeds)
    assert 0 < ok.sum() < 200
    for pose, seed, row, fine in zip(poses, seeds, batch, ok, strict=True):
        if fine:
            np.testing.assert_allclose(arm.inverse(pose, seed), row, rtol=0, atol=1e-9)
        else:
            with pytest.raises(NoSolutionError):
                arm.inverse(pose, seed)


def test_one_seed_serves_all_rows_and_no_rows_are_fine() -> None:
    arm = arm_with("large_needle_driver_400006")
    q = np.random.default_rng(3).uniform(arm.lower, arm.upper, (5, 6))
    batch, ok = arm.inverse_batch(arm.forward_batch(q), np.zeros(6))
    assert batch.shape == (5, 6) and ok.all()
    empty, none = arm.inverse_batch(np.empty((0, 4, 4)), np.zeros(6))
    assert empty.shape == (0, 6) and none.shape == (0,)


def test_a_degenerate_row_is_marked_and_leaves_the_others_alone() -> None:
    arm = arm_with("large_needle_driver_400006")
    good = arm.forward_batch(np.array([[0.1, 0.1, 0.1, 0.1, 0.1, 0.1]]))[0]
    batch, ok = arm.inverse_batch(np.stack([np.eye(4), good]), np.zeros(6))
    assert ok.tolist() == [False, True]
    assert np.isnan(batch[0]).all() and np.isfinite(batch[1]).all()


def test_every_branch_is_a_solution_and_only_one_lies_inside_the_limits() -> None:
    arm = arm_with("large_needle_driver_400006")
    geometry = PsmGeometry.of(arm.description)
    for q in np.random.default_rng(4).uniform(arm.lower, arm.upper, (50, 6)):
        pose = arm.forward(q)
        R6 = pose.rotation @ geometry.tip_rotation.T
        x, z, p = (tuple(v.tolist()) for v in (R6[:, 0], R6[:, 2], pose.translation))
        inside = 0
        for branch in BRANCHES:
            found = np.array(branch_solution(geometry, x, z, p, branch))
            np.testing.assert_allclose(
                arm.forward(found).homogeneous, pose.homogeneous, rtol=0, atol=1e-9
            )
            found[3] = nearest_turn(found[3], 0.0, arm.lower[3], arm.upper[3])
            inside += bool((found >= arm.lower).all() and (found <= arm.upper).all())
        assert inside == 1


def test_wrist_yaw_just_past_a_right_angle_is_found_on_another_branch() -> None:
    arm = arm_with("maryland_bipolar_forceps_400172")
    assert arm.upper[5] > math.pi / 2
    q = np.array([0.2, 0.1, 0.12, 0.3, 0.4, arm.upper[5]])
    np.testing.assert_allclose(arm.inverse(arm.forward(q), q), q, atol=1e-9)
    batch, ok = arm.inverse_batch(arm.forward_batch(q[None]), q)
    assert ok.all()
    np.testing.assert_allclose(batch[0], q, atol=1e-9)


def test_a_pose_made_at_the_limits_is_reachable_and_stays_on_them() -> None:
    arm = arm_with("large_needle_driver_400006")
    for q in (arm.lower, arm.upper):
        corner = q.copy()
        corner[2] = 0.1
        found = arm.inverse(arm.forward(corner), corner)
        assert (found >= arm.lower).all() and (found <= arm.upper).all()
        np.testing.assert_allclose(found, corner, atol=1e-9)


@pytest.mark.parametrize(
    ("angle", "seed", "expected"),
    [
        (0.0, 7.0, 0.0),
        (0.5, 0.0, 0.5),
        (3.0, -3.0, 3.0 - TURN),
        (-3.0, 3.0, -3.0 + TURN),
        (1.0, 40.0, 1.0),
        (-1.0, -40.0, -1.0),
        (4.53786 + 1e-12, 4.5, 4.53786 + 1e-12),
    ],
)
def test_the_nearest_turn_stays_inside_the_limits(
    angle: float, seed: float, expected: float
) -> None:
    assert nearest_turn(angle, seed, -4.53786, 4.53786) == pytest.approx(expected, abs=1e-15)


def test_where_no_turn_is_inside_the_least_excess_is_reported() -> None:
    assert nearest_turn(3.0, 0.0, -2.0, 2.0) == 3.0
    assert nearest_turn(3.0, -9.0, -2.0, 2.0) == pytest.approx(3.0)
    assert nearest_turn(-3.0, 9.0, -2.0, 2.0) == pytest.approx(-3.0)


def test_an_arm_of_another_pattern_is_refused_with_the_row() -> None:
    description = load_robot("psm_classic", "large_needle_driver_400006")
    bent = description.joints[4].model_copy(update={"d_m": 0.01})
    other = replace(description, joints=(*description.joints[:4], bent, description.joints[5]))
    with pytest.raises(KinematicsError, match="row wrist_pitch is not a PSM's"):
        Arm(other)


def test_batches_of_wrong_shape_or_content_are_refused() -> None:
    arm = arm_with("large_needle_driver_400006")
    with pytest.raises(KinematicsError, match=r"\(N, 4, 4\)"):
        arm.inverse_batch(np.eye(4), np.zeros(6))
    with pytest.raises(IkError, match="not finite"):
        arm.inverse_batch(np.full((1, 4, 4), math.nan), np.zeros(6))
    with pytest.raises(IkError, match="seed"):
        arm.inverse_batch(np.eye(4)[None], np.full(6, math.nan))
    with pytest.raises(KinematicsError, match=r"T_base_tip\[1\]"):
        arm.inverse_batch(np.stack([np.eye(4), np.diag([1.0, 1.0, -1.0, 1.0])]), np.zeros(6))
    with pytest.raises(KinematicsError, match=r"\(N, 6\)"):
        arm.forward_batch(np.zeros((2, 5)))
