"""The kinematic services of a simulated dVRK arm."""

from __future__ import annotations

import numpy as np
import pytest
from crtk_rig import Rig

from viskill_deploy.core.description import load_cell
from viskill_deploy.drivers.crtk.arm_cartesian import matrix, pose_of
from viskill_deploy.drivers.crtk.kinematics_services import KinematicsServices
from viskill_deploy.drivers.crtk.messages import (
    ForwardKinematicsRequest,
    InverseKinematicsRequest,
    Point,
    Pose,
)
from viskill_deploy.kinematics.arm import Arm

CELL = load_cell("bipegtransfer")
Q = (0.2, -0.1, 0.12, 0.3, 0.2, -0.2)


@pytest.fixture
def services() -> KinematicsServices:
    return KinematicsServices(CELL.arms[0])


def test_forward_kinematics_is_that_of_the_arm_in_either_frame(
    services: KinematicsServices,
) -> None:
    local = Arm(CELL.arms[0].arm).forward(Q).homogeneous
    answer = services.local(ForwardKinematicsRequest(Q))
    assert answer.result
    assert matrix(answer.cp) == pytest.approx(local, abs=1e-12)
    placed = matrix(services.forward(ForwardKinematicsRequest(Q)).cp)
    assert placed == pytest.approx(CELL.arms[0].T_task_base @ local, abs=1e-12)


def test_fewer_joints_give_a_frame_on_the_way(services: KinematicsServices) -> None:
    # yaw and pitch turn about the remote centre; the insertion slides along the shaft from there
    for count in (0, 1, 2):
        p = matrix(services.local(ForwardKinematicsRequest(Q[:count])).cp)[:3, 3]
        assert np.linalg.norm(p) == pytest.approx(0.0, abs=1e-12)
    p = matrix(services.local(ForwardKinematicsRequest(Q[:3])).cp)[:3, 3]
    shaft = np.array([np.sin(0.2) * np.cos(-0.1), -np.sin(-0.1), -np.cos(0.2) * np.cos(-0.1)])
    assert p == pytest.approx((0.12 - 0.4318) * shaft, abs=1e-5)
    wrist = matrix(services.local(ForwardKinematicsRequest(Q[:5])).cp)[:3, 3]
    assert wrist == pytest.approx((0.12 - 0.0156) * shaft, abs=1e-5)


def test_inverse_kinematics_solves_in_the_arms_own_frame(services: KinematicsServices) -> None:
    pose = pose_of(Arm(CELL.arms[0].arm).forward(Q).homogeneous)
    for seed in (Q, ()):
        answer = services.inverse(InverseKinematicsRequest(pose, seed))
        assert answer.result
        assert answer.jp == pytest.approx(Q, abs=1e-9)


def test_questions_without_an_answer_say_why(services: KinematicsServices) -> None:
    nan = float("nan")
    for answer in (
        services.inverse(InverseKinematicsRequest(Pose(Point(1.0, 0.0, 0.0)))),
        services.inverse(InverseKinematicsRequest(Pose(Point(nan, 0.0, 0.0)))),
        services.inverse(InverseKinematicsRequest(Pose(Point(0.0, 0.0, -0.1)), (0.0,) * 5)),
        services.forward(ForwardKinematicsRequest((0.0,) * 7)),
        services.forward(ForwardKinematicsRequest((nan,))),
    ):
        assert not answer.result
        assert answer.message


def test_services_are_offered_where_the_transport_has_them() -> None:
    rig = Rig()
    for arm in ("PSM1", "PSM2"):
        for name in ("forward_kinematics", "local/forward_kinematics"):
            answer = rig.exchange.call(f"/{arm}/{name}", ForwardKinematicsRequest(Q))
            assert answer.result
        request = InverseKinematicsRequest(rig.client.last("local/measured_cp").pose)
        assert rig.exchange.call(f"/{arm}/inverse_kinematics", request).result
