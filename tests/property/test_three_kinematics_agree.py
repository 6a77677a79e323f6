"""Pinocchio, the gate's own arithmetic and MuJoCo put the tip in the same place."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from viskill_deploy.core.description import load_cell, load_robot
from viskill_deploy.kinematics.arm import Arm
from viskill_deploy.safety.geometry import Chain
from viskill_deploy.sim.scene import build_model

CONFIGURATIONS = 10_000


@pytest.mark.parametrize(
    ("robot", "tool"),
    [("psm_classic", "large_needle_driver_400006"), ("psm_si", "large_needle_driver_420006")],
)
def test_three_forward_kinematics_agree_within_a_nanometre(robot: str, tool: str) -> None:
    cell = load_cell("bipegtransfer")
    placed = replace(cell.arms[0], arm=load_robot(robot, tool))
    cell = replace(cell, arms=(placed, cell.arms[1]))
    arm, chain, model = Arm(placed.arm), Chain.of(placed), build_model(cell)
    data = mujoco.MjData(model)
    columns = [model.joint(f"PSM1/{j.name}").qposadr[0] for j in placed.arm.joints]
    site = data.site("PSM1/tip")
    worst = 0.0
    for q in np.random.default_rng(0).uniform(arm.lower, arm.upper, (CONFIGURATIONS, 6)):
        pinocchio = arm.forward(q).homogeneous
        gate = np.array(chain.tip_pose(tuple(q.tolist())))
        data.qpos[columns] = q
        mujoco.mj_kinematics(model, data)
        in_task = placed.T_task_base @ pinocchio
        worst = max(
            worst,
            float(np.abs(gate - pinocchio[:3]).max()),
            float(np.abs(site.xpos - in_task[:3, 3]).max()),
            float(np.abs(site.xmat.reshape(3, 3) - in_task[:3, :3]).max()),
        )
    assert worst <= 1e-9
