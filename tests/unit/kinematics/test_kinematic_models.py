"""Pinocchio's model and the batched forward kinematics are two programs of one description."""

from __future__ import annotations

import numpy as np
import pytest

from viskill_deploy.core.description import load_robot
from viskill_deploy.kinematics.arm import Arm
from viskill_deploy.kinematics.model import SHAFT_FRAME, TIP_FRAME, build_model

FITTING = [
    ("psm_classic", "large_needle_driver_400006"),
    ("psm_si", "large_needle_driver_420006"),
    ("psm_classic", "stapler_45_410298"),
]


@pytest.mark.parametrize(("robot", "tool"), FITTING)
def test_pinocchio_and_the_batch_agree_on_ten_thousand_configurations(
    robot: str, tool: str
) -> None:
    arm = Arm(load_robot(robot, tool))
    q = np.random.default_rng(0).uniform(arm.lower, arm.upper, (10_000, 6))
    batch = arm.forward_batch(q)
    one_by_one = np.array([arm.forward(row).homogeneous for row in q])
    np.testing.assert_allclose(batch, one_by_one, rtol=0, atol=1e-12)


def test_the_zero_pose_is_the_one_that_the_dvrk_documents() -> None:
    arm = Arm(load_robot("psm_classic", "large_needle_driver_400006"))
    pose = arm.forward((0, 0, 0.12, 0, 0, 0))
    np.testing.assert_allclose(pose.rotation, [[0, 1, 0], [1, 0, 0], [0, 0, -1]], atol=1e-12)
    np.testing.assert_allclose(pose.translation, [0, 0, -0.1135], atol=1e-12)
    assert arm.forward((0.1, 0, 0.12, 0, 0, 0)).translation[0] > 0
    assert arm.forward((0, 0.1, 0.12, 0, 0, 0)).translation[1] < 0


def test_the_model_carries_the_descriptions_limits_and_frames() -> None:
    description = load_robot("psm_si", "large_needle_driver_420006")
    model = build_model(description)
    assert model.nq == model.nv == 6
    np.testing.assert_array_equal(model.lowerPositionLimit, description.limit(0))
    np.testing.assert_array_equal(model.upperPositionLimit, description.limit(1))
    np.testing.assert_array_equal(model.velocityLimit, description.limit(2))
    assert list(model.names)[1:] == [joint.name for joint in description.joints]
    assert model.existFrame(TIP_FRAME) and model.existFrame(SHAFT_FRAME)
