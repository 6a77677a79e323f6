"""The arm against shared vectors that a compiled cisst made, and what it refuses."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import viskill_deploy
from viskill_deploy import Arm, load_arm
from viskill_deploy.core.errors import IkError, KinematicsError, NoSolutionError

GOLDEN = Path(__file__).parents[2] / "golden"
FK = dict(np.load(GOLDEN / "psm_fk.npz"))
IK = dict(np.load(GOLDEN / "psm_ik.npz"))
ARMS = [load_arm("psm_classic", tool=str(name).lower()) for name in FK["tool_names"]]
LND = ARMS[0]
SEED = (0.1, -0.1, 0.12, 0.3, 0.2, -0.2)


def as_the_cpp_has_it(arm: Arm) -> Arm:
    """The same arm with offsets of 1.5708, which the C++ keeps as written."""
    joints = tuple(
        joint
        if joint.type == "prismatic" or not joint.offset
        else joint.model_copy(update={"offset_rad": math.copysign(1.5708, joint.offset)})
        for joint in arm.description.joints
    )
    return Arm(replace(arm.description, joints=joints))


CPP_ARMS = [as_the_cpp_has_it(arm) for arm in ARMS]


def test_forward_gives_every_exact_pose_within_a_nanometre() -> None:
    for q, tool, pose in zip(FK["q"], FK["tool_id"], FK["pose_exact"], strict=True):
        np.testing.assert_allclose(ARMS[tool].forward(q).homogeneous, pose, rtol=0, atol=1e-9)


def test_forward_with_offsets_as_written_gives_the_poses_of_the_cpp() -> None:
    for q, tool, pose in zip(FK["q"], FK["tool_id"], FK["pose"], strict=True):
        np.testing.assert_allclose(CPP_ARMS[tool].forward(q).homogeneous, pose, rtol=0, atol=1e-9)


def test_jacobian_agrees_with_the_vectors() -> None:
    for q, tool, J in zip(FK["q"], FK["tool_id"], FK["jacobian"], strict=True):
        np.testing.assert_allclose(ARMS[tool].jacobian(q), J, rtol=0, atol=2e-5)


def test_jacobian_agrees_with_central_differences_of_forward() -> None:
    step = 1e-6
    for q, tool in zip(FK["q"][::4], FK["tool_id"][::4], strict=True):
        arm, columns = ARMS[tool], []
        for unit in np.eye(6):
            ahead, behind = arm.forward(q + step * unit), arm.forward(q - step * unit)
            turn = pin.log3(ahead.rotation @ behind.rotation.T)
            columns.append(np.r_[ahead.translation - behind.translation, turn] / (2 * step))
        np.testing.assert_allclose(arm.jacobian(q), np.array(columns).T, rtol=0, atol=1e-6)


def test_limits_are_those_of_the_vectors() -> None:
    for arm, lower, upper in zip(ARMS, FK["qmin"], FK["qmax"], strict=True):
        np.testing.assert_array_equal(arm.lower, lower)
        np.testing.assert_array_equal(arm.upper, upper)


@pytest.mark.parametrize("i", np.flatnonzero(IK["reachable"]))
def test_inverse_solves_every_reachable_pose_inside_the_limits(i: int) -> None:
    arm, seed = ARMS[IK["tool_id"][i]], IK["seed"][i]
    q = arm.inverse(IK["pose"][i], seed)
    assert (q >= arm.lower).all() and (q <= arm.upper).all()
    np.testing.assert_allclose(arm.forward(q).homogeneous, IK["pose"][i], rtol=0, atol=1e-9)
    rolls = IK["q_roll_alternatives"][i]
    nearest = rolls[np.nanargmin(np.abs(rolls - seed[3]))]
    np.testing.assert_allclose(q[[0, 1, 2, 4, 5]], IK["q"][i][[0, 1, 2, 4, 5]], atol=1e-5)
    assert q[3] == pytest.approx(nearest, abs=1e-5)


@pytest.mark.parametrize("i", np.flatnonzero(~IK["reachable"]))
def test_inverse_refuses_every_unreachable_pose_and_names_the_right_joint(i: int) -> None:
    arm = ARMS[IK["tool_id"][i]]
    with pytest.raises(NoSolutionError) as refusal:
        arm.inverse(IK["pose"][i], IK["seed"][i])
    error = refusal.value
    assert error.joint == IK["violated"][i]
    assert error.name == arm.description.joints[error.joint].name
    assert error.name in str(error)
    low, high = arm.lower[error.joint], arm.upper[error.joint]
    assert error.excess == pytest.approx(max(low - error.value, error.value - high))
    assert error.excess > 0


def test_inverse_with_offsets_as_written_returns_the_vectors_joints() -> None:
    for i in np.flatnonzero(IK["reachable"]):
        q = CPP_ARMS[IK["tool_id"][i]].inverse(IK["pose"][i], IK["q"][i])
        np.testing.assert_allclose(q, IK["q"][i], rtol=0, atol=1e-9)


def test_inverse_takes_an_se3_as_well_as_an_array() -> None:
    pose = LND.forward(SEED)
    np.testing.assert_array_equal(
        LND.inverse(pose, SEED), LND.inverse(pose.homogeneous, list(SEED))
    )


@pytest.mark.parametrize("seed_roll", [-4.0, -2.0, 0.0, 2.0, 4.0])
def test_inverse_takes_the_turn_of_roll_nearest_to_the_seed(seed_roll: float) -> None:
    pose = LND.forward((0.1, 0.1, 0.12, 2.5, 0.1, 0.1))
    roll = LND.inverse(pose, (0, 0, 0.1, seed_roll, 0, 0))[3]
    turns = [2.5 - 2 * math.pi, 2.5]
    assert roll == pytest.approx(min(turns, key=lambda turn: abs(turn - seed_roll)))


@pytest.mark.parametrize("insertion", [0.0156, 0.0156 - 0.0091])
def test_wrist_or_tip_on_the_remote_centre_is_refused_as_degenerate(insertion: float) -> None:
    pose = LND.forward((0.0, 0.0, insertion, 0.3, 0.0, 0.2))
    with pytest.raises(NoSolutionError, match="remote centre") as refusal:
        LND.inverse(pose, SEED)
    assert refusal.value.joint == -1
    assert math.isnan(refusal.value.excess)


def test_rcm_error_is_zero_at_the_mechanical_centre_and_two_millimetres_beside_it() -> None:
    rng = np.random.default_rng(1)
    for q in rng.uniform(LND.lower, LND.upper, (50, 6)):
        assert LND.rcm_error(q, (0.0, 0.0, 0.0)) < 1e-15
    assert LND.rcm_error((0, 0, 0.12, 0, 0, 0), (0.002, 0.0, 0.0)) == pytest.approx(0.002)
    assert LND.rcm_error((0, 0, 0.12, 1.0, 0.5, 0), (0.0, 0.002, 0.0)) == pytest.approx(0.002)
    across = math.cos(0.5) * 0.002
    assert LND.rcm_error((0.5, 0, 0.12, 0, 0, 0), (0.002, 0, 0)) == pytest.approx(across)


def test_resolve_follows_a_path_with_roll_beyond_half_a_turn_and_no_jump() -> None:
    q = np.tile(np.array(SEED), (200, 1))
    q[:, 3] = np.linspace(-4.4, 4.4, 200)
    np.testing.assert_allclose(LND.resolve(LND.forward_batch(q), q[0]), q, atol=1e-9)


def test_resolve_refuses_a_path_whose_roll_would_have_to_jump_a_turn() -> None:
    q = np.tile(np.array(SEED), (200, 1))
    q[:, 3] = np.linspace(3.0, 5.0, 200)
    with pytest.raises(NoSolutionError, match="another turn of roll") as refusal:
        LND.resolve(LND.forward_batch(q), q[0])
    assert refusal.value.joint == 3


def test_resolve_names_the_pose_that_is_out_of_reach() -> None:
    q = np.tile(np.array(SEED), (3, 1))
    q[2, 2] = LND.upper[2] + 0.02
    with pytest.raises(NoSolutionError, match="pose 2") as refusal:
        LND.resolve(LND.forward_batch(q), SEED)
    assert (refusal.value.joint, refusal.value.name) == (2, "insertion")
    assert refusal.value.excess == pytest.approx(0.02)


@pytest.mark.parametrize("call", ["forward", "jacobian"])
def test_joints_that_are_not_six_finite_numbers_are_refused(call: str) -> None:
    with pytest.raises(KinematicsError, match="give six numbers"):
        getattr(LND, call)((0.0,) * 5)
    with pytest.raises(IkError, match="finite"):
        getattr(LND, call)((0, 0, math.nan, 0, 0, 0))
    with pytest.raises(KinematicsError, match="port"):
        LND.rcm_error(SEED, (0.0, math.nan, 0.0))


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda T: T * math.nan, "not finite"),
        (lambda T: T[:3], "shape"),
        (lambda T: T * [[1.001], [1.001], [1.001], [1]], "rigid"),
        (lambda T: T * [[-1], [1], [1], [1]], "rigid"),
        (lambda T: np.zeros((4, 4)), "rigid"),
        (lambda T: T + np.eye(4)[3][:, None], "last row"),
    ],
)
def test_what_is_no_rigid_pose_is_refused(spoil: object, reason: str) -> None:
    pose = spoil(LND.forward(SEED).homogeneous)  # type: ignore[operator]
    with pytest.raises(KinematicsError, match=reason):
        LND.inverse(pose, SEED)


def test_the_package_offers_its_names_and_no_others() -> None:
    assert viskill_deploy.IkSolver.__name__ == "IkSolver"
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = viskill_deploy.nonsense


def test_a_shared_arm_hands_out_poses_that_do_not_change_later() -> None:
    first = LND.forward(SEED)
    before = first.homogeneous.copy()
    LND.forward((0.0, 0.0, 0.2, 0.0, 0.0, 0.0))
    np.testing.assert_array_equal(first.homogeneous, before)
