import math

import mujoco
import numpy as np
import pytest

from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.kinematics.model import forward_batch
from viskill_deploy.sim.scene import build_model


@pytest.fixture(scope="module")
def cell() -> CellDescription:
    return load_cell("bipegtransfer")


@pytest.fixture(scope="module")
def model(cell: CellDescription) -> mujoco.MjModel:
    return build_model(cell)


def test_the_models_tip_is_where_forward_kinematics_says_for_1000_random_configurations(
    cell: CellDescription, model: mujoco.MjModel
) -> None:
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    q = {arm.name: rng.uniform(arm.arm.limit(0), arm.arm.limit(1), (1000, 6)) for arm in cell.arms}
    expected = {
        arm.name: arm.T_task_base @ forward_batch(arm.arm, q[arm.name]) for arm in cell.arms
    }
    worst = 0.0
    for i in range(1000):
        for arm in cell.arms:
            for joint, value in zip(arm.arm.joints, q[arm.name][i], strict=True):
                data.joint(f"{arm.name}/{joint.name}").qpos = value
        mujoco.mj_kinematics(model, data)
        for arm in cell.arms:
            site, pose = data.site(f"{arm.name}/tip"), expected[arm.name][i]
            worst = max(worst, float(np.abs(site.xpos - pose[:3, 3]).max()))
            worst = max(worst, float(np.abs(site.xmat.reshape(3, 3) - pose[:3, :3]).max()))
    assert worst < 1e-9


def test_the_settings_that_make_friction_grasps_hold_are_in_the_model(
    model: mujoco.MjModel,
) -> None:
    option = model.opt
    assert option.integrator == mujoco.mjtIntegrator.mjINT_DISCRETE
    assert option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert option.impratio == 10.0
    assert option.jacobian == mujoco.mjtJacobian.mjJAC_DENSE
    assert model.geom("PSM1/jaw_left").condim == 4
    assert model.geom("block0/wall0").condim == 4


def test_joints_are_driven_with_the_gains_and_limits_of_their_files(
    cell: CellDescription, model: mujoco.MjModel
) -> None:
    for arm in cell.arms:
        for joint in arm.arm.joints:
            armature, stiffness, damping, _, effort = joint.servo
            name = f"{arm.name}/{joint.name}"
            drive = model.actuator(name)
            assert drive.biasprm[1] == pytest.approx(-stiffness)
            assert drive.biasprm[2] == pytest.approx(-damping)
            assert drive.forcerange.tolist() == pytest.approx([-effort, effort])
            dof = model.jnt_dofadr[model.joint(name).id]
            assert model.dof_armature[dof] == pytest.approx(armature)
            assert model.dof_frictionloss[dof] == 0.0


def test_joint_friction_is_an_option(cell: CellDescription) -> None:
    model = build_model(cell, friction=True)
    dof = model.jnt_dofadr[model.joint("PSM1/yaw").id]
    assert model.dof_frictionloss[dof] == pytest.approx(0.06)


def test_a_jaw_opens_symmetrically_about_the_tips_z_axis(
    cell: CellDescription, model: mujoco.MjModel
) -> None:
    data = mujoco.MjData(model)
    data.joint("PSM1/jaw_left").qpos = data.joint("PSM1/jaw_right").qpos = 0.3
    mujoco.mj_kinematics(model, data)
    site = data.site("PSM1/tip")
    R, length = site.xmat.reshape(3, 3), cell.arms[0].arm.jaw.finger_length_m
    for side, sign in (("left", 1.0), ("right", -1.0)):
        finger = data.body(f"PSM1/jaw_{side}")
        end = finger.xpos + length * finger.xmat.reshape(3, 3)[:, 2] - site.xpos
        expected = length * np.array([0.0, sign * math.sin(0.3), math.cos(0.3)])
        assert R.T @ end == pytest.approx(expected, abs=1e-12)


def test_a_block_weighs_what_its_file_says_and_its_hole_admits_peg_and_finger(
    cell: CellDescription, model: mujoco.MjModel
) -> None:
    block, board = cell.file.block, cell.file.board
    assert block is not None
    assert board is not None
    assert float(model.body("block0").mass[0]) == pytest.approx(block.mass_kg)
    hole = block.wall_inradius_m - block.wall_thickness_m / 2
    finger = 2 * float(model.geom("PSM1/jaw_left").size[1])
    assert hole - board.peg_radius_m > 2 * finger


def test_everything_seen_has_a_named_material_and_the_cameras_exist(
    cell: CellDescription, model: mujoco.MjModel
) -> None:
    for name in ("overview", *(camera.name for camera in cell.file.camera)):
        assert model.camera(name).id >= 0
    for geom in range(model.ngeom):
        assert model.geom(geom).matid[0] >= 0 or model.geom(geom).name == "floor"


def test_an_arm_without_servo_values_is_refused_by_name(cell: CellDescription) -> None:
    arm = cell.arms[0]
    first = arm.arm.joints[0].model_copy(update={"dynamics": None})
    bare = arm.arm.__class__(**{**arm.arm.__dict__, "joints": (first, *arm.arm.joints[1:])})
    broken = arm.__class__(arm.name, bare, arm.T_task_base, arm.entry)
    lame = CellDescription(cell.name, (broken,), cell.file, cell.files)
    with pytest.raises(DataFileError, match="yaw"):
        build_model(lame)
