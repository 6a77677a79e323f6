from dataclasses import replace

import mujoco
import numpy as np
import pytest

from viskill_deploy.core import data
from viskill_deploy.core.cell_files import CellArmEntry
from viskill_deploy.core.description import CellArm, load_cell, load_robot
from viskill_deploy.kinematics.arm import Arm
from viskill_deploy.kinematics.model import forward_batch
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.geometry import Chain
from viskill_deploy.safety.rules.s15_conditioning import CHANGE, smallest_singular_value
from viskill_deploy.sim.world import World

CELL = load_cell("bipegtransfer")

PAIRS = [
    (robot, tool)
    for robot, mark in (("psm_classic", "_400"), ("psm_si", "_420"))
    for tool in data.names("robots/tools")
    if mark in tool
]


def placed(arm) -> CellArm:
    somewhere = load_cell("bipegtransfer").arms[1]
    entry: CellArmEntry = somewhere.entry
    return CellArm("PSM2", arm, somewhere.T_task_base, entry)


def within_limits(arm, count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform(arm.limit(0), arm.limit(1), size=(count, 6))


@pytest.mark.invariant("S15")
@pytest.mark.parametrize(("robot", "tool"), PAIRS)
def test_the_jacobian_is_that_of_the_other_kinematics_and_changes_no_faster_than_is_said(
    robot, tool
):
    """In the cannula too; the smallest singular value by central differences."""
    description = load_robot(robot, tool)
    envelope = replace(CellEnvelope.of(CELL, 0.004).arms[1], chain=Chain.of(placed(description)))
    other, step = Arm(description), 1e-6
    for q in within_limits(description, 12, 2):
        ours = np.array(envelope.chain.jacobian((*q.tolist(), 0.3))).T
        assert abs(ours - other.jacobian(q)).max() < 1e-9
        for joint, most in enumerate(CHANGE):
            ends = [q + side * step * np.eye(6)[joint] for side in (-1.0, 1.0)]
            low, high = (smallest_singular_value(envelope, tuple(end.tolist())) for end in ends)
            assert abs(high - low) / (2.0 * step) <= most + 1e-8


@pytest.mark.parametrize(
    ("robot", "tool"),
    [("psm_classic", "large_needle_driver_400006"), ("psm_si", "large_needle_driver_420006")],
)
def test_ten_thousand_poses_are_those_of_the_other_kinematics(robot, tool):
    arm = load_robot(robot, tool)
    chain, q = Chain.of(placed(arm)), within_limits(arm, 10_000, 0)
    expected = forward_batch(arm, q)
    ours = np.array([chain.tip_pose(tuple(row)) for row in q.tolist()])
    assert abs(ours - expected[:, :3]).max() < 1e-9


@pytest.mark.parametrize(("robot", "tool"), PAIRS)
def test_every_instrument_gives_the_same_pose(robot, tool):
    arm = load_robot(robot, tool)
    chain, q = Chain.of(placed(arm)), within_limits(arm, 20, 1)
    ours = np.array([chain.tip_pose(tuple(row)) for row in q.tolist()])
    assert abs(ours - forward_batch(arm, q)[:, :3]).max() < 1e-9


def test_control_point_and_jaw_end_are_in_the_task_frame():
    cell_arm = load_cell("bipegtransfer").arms[0]
    chain, q = Chain.of(cell_arm), within_limits(cell_arm.arm, 200, 2)
    pose = cell_arm.T_task_base @ forward_batch(cell_arm.arm, q)
    points = np.array([chain.points(tuple(row)) for row in q.tolist()])
    finger = cell_arm.arm.jaw.finger_length_m
    assert abs(points[:, 0] - pose[:, :3, 3]).max() < 1e-12
    assert abs(points[:, 1] - pose[:, :3, 3] - finger * pose[:, :3, 2]).max() < 1e-12


def test_a_jaw_angle_after_the_joints_is_not_read():
    chain = Chain.of(load_cell("bipegtransfer").arms[0])
    q = (0.1, -0.2, 0.1, 0.3, 0.2, -0.1)
    assert chain.points((*q, 1.0)) == chain.points(q)


@pytest.mark.parametrize("arm", range(2))
@pytest.mark.invariant("S14")
def test_shaft_and_wrist_lie_where_the_simulator_has_them(arm):
    """The ends of the gate's capsules against those of the simulator's, in random poses."""
    world = World(load_cell("bipegtransfer"))
    cell_arm = world.cell.arms[arm]
    chain, name = Chain.of(cell_arm), cell_arm.name
    data, model = world.data, world.model
    shaft, wrist = (model.geom(f"{name}/{part}") for part in ("shaft", "wrist"))
    assert shaft.size[0] == cell_arm.arm.shape.shaft_radius_m
    assert wrist.size[0] == cell_arm.arm.shape.wrist_radius_m
    for q in within_limits(cell_arm.arm, 50, 3).tolist():
        for joint, position in zip(cell_arm.arm.joints, q, strict=True):
            data.joint(f"{name}/{joint.name}").qpos[0] = position
        mujoco.mj_kinematics(model, data)
        point, _, at_wrist, shaft_end = map(np.array, chain.points(tuple(q)))
        ends = [
            [
                data.geom(g.id).xpos + sign * g.size[1] * data.geom(g.id).xmat.reshape(3, 3)[:, 2]
                for sign in (-1.0, 1.0)
            ]
            for g in (shaft, wrist)
        ]
        assert min(abs(end - shaft_end).max() for end in ends[0]) < 1e-9
        for there in (point, at_wrist):
            assert min(abs(end - there).max() for end in ends[1]) < 1e-9
