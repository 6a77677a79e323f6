"""An arm of a lab's own: three models from one file, and an inverse that keeps the port."""

import mujoco
import numpy as np
import pytest

from viskill_deploy.core.description import load_cell, load_robot
from viskill_deploy.core.errors import DataFileError, IkError, KinematicsError
from viskill_deploy.kinematics.arm import Arm, load_arm
from viskill_deploy.kinematics.model import forward_batch, port_distances, tip_positions
from viskill_deploy.kinematics.straight import StraightArm, placed_arm
from viskill_deploy.motion.resolve import base_poses
from viskill_deploy.motion.waypoints import downward_pose
from viskill_deploy.safety.geometry import Chain
from viskill_deploy.sim.scene import build_model

CELL = load_cell("bodytrainer")
ENTRY = CELL.arms[0]
ARM = ENTRY.arm
MODEL = placed_arm(ENTRY)
assert isinstance(MODEL, StraightArm)
COUNT = 200


def anywhere(count: int = COUNT, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(ARM.limit(0), ARM.limit(1), (count, 7))


def place(position: tuple[float, float, float], yaw: float = 0.0) -> np.ndarray:
    """A downward pose in the task frame, seen from the arm's base."""
    return base_poses(CELL, 0, downward_pose(position, yaw)[None])[0]


def test_tip_and_jaw_end_are_the_same_by_pinocchio_gate_and_simulator():
    model = build_model(CELL)
    data, chain = mujoco.MjData(model), Chain.of(ENTRY)
    for q in anywhere():
        T = ENTRY.T_task_base @ MODEL.pose(q)
        point, jaw_end, wrist, shaft_end = map(np.array, chain.points((*q.tolist(), 0.3)))
        assert abs(point - T[:3, 3]).max() < 1e-9
        assert abs(jaw_end - (T[:3, 3] + ARM.jaw.finger_length_m * T[:3, 2])).max() < 1e-9
        assert abs(wrist - point).max() < 1e-12
        assert abs(shaft_end - (point - ARM.shape.shaft_radius_m * T[:3, 2])).max() < 1e-9
        assert abs(np.array(chain.tip_pose((*q.tolist(), 0.3))) - MODEL.pose(q)[:3]).max() < 1e-9
        data.qpos[:7] = q
        mujoco.mj_kinematics(model, data)
        site = data.site("ARM1/tip")
        assert abs(site.xpos - T[:3, 3]).max() < 1e-9
        assert abs(site.xmat.reshape(3, 3) - T[:3, :3]).max() < 1e-9


def test_the_forms_for_many_configurations_are_those_for_one():
    q = anywhere(20)
    one_by_one = np.array([MODEL.pose(row) for row in q])
    assert abs(forward_batch(ARM, q) - one_by_one).max() < 1e-12
    assert abs(tip_positions(ARM, q) - one_by_one[:, :3, 3]).max() < 1e-12
    port = ENTRY.port_in_base
    expected = [MODEL.rcm_error(row, port) for row in q]
    assert abs(port_distances(ARM, q, port) - expected).max() < 1e-12


def test_the_inverse_brings_the_tip_there_with_its_shaft_in_the_port():
    q = MODEL.inverse(place((0.0, 0.0, 0.06)), ENTRY.seed)
    for position, yaw in [((0.05, -0.05, 0.02), 0.0), ((-0.05, 0.04, 0.08), 0.4)]:
        wanted = place(position, yaw)
        q = MODEL.inverse(wanted, q)
        assert abs(MODEL.pose(q)[:3, 3] - wanted[:3, 3]).max() < 1e-8
        assert MODEL.rcm_error(q, ENTRY.port_in_base) < 1e-8


def test_a_pose_that_points_through_the_port_already_is_left_as_it_is():
    wanted = place((0.0, 0.0, 0.06), 0.3)
    assert abs(MODEL.aimed(wanted).homogeneous - wanted).max() < 1e-12


@pytest.mark.parametrize("height", [0.169, 0.2])
def test_a_tip_at_the_port_or_outside_the_body_is_refused(height):
    with pytest.raises(KinematicsError, match="inside the body"):
        MODEL.inverse(place((0.0, 0.0, height)), ENTRY.seed)


def test_a_pose_out_of_reach_is_refused_with_its_place_in_the_path():
    near, far = place((0.0, 0.0, 0.06)), place((0.0, 0.0, -0.9))
    with pytest.raises(IkError):
        MODEL.inverse(far, ENTRY.seed)
    with pytest.raises(KinematicsError, match="pose 1"):
        MODEL.resolve(np.array([near, far]), ENTRY.seed)


def test_what_asks_for_a_closed_form_is_refused():
    arm = Arm(ARM)
    with pytest.raises(KinematicsError, match="no closed form"):
        arm.inverse(place((0.0, 0.0, 0.06)), ENTRY.seed)
    with pytest.raises(KinematicsError, match="give 7 numbers"):
        arm.forward((0.0,) * 6)


def test_the_instrument_is_the_one_in_the_robots_own_file():
    assert load_arm("iiwa14_straight", "straight_grasper_400mm").description.axes == 8
    with pytest.raises(DataFileError, match="holds straight_grasper_400mm"):
        load_robot("iiwa14_straight", "large_needle_driver_400006")
