import numpy as np
import pytest

from viskill_deploy.core import data
from viskill_deploy.core.cell_files import CellArmEntry
from viskill_deploy.core.description import CellArm, load_cell, load_robot
from viskill_deploy.kinematics.model import forward_batch
from viskill_deploy.safety.geometry import Chain

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
