"""A world that is not as its cell's file says: what calibration has to find."""

import numpy as np
import pytest
from measured_arm import TYPICAL

from viskill_deploy.core.arm_errors import ArmErrors, with_errors
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.types import FloatArray, JointSetpoint
from viskill_deploy.kinematics.model import forward_batch
from viskill_deploy.sim.tasks import load_task
from viskill_deploy.sim.world import World, WorldOptions

CELL = load_cell("bipegtransfer")
TRUTH = (TYPICAL, ArmErrors())


def _world(truth: tuple[ArmErrors, ...]) -> World:
    world = World(CELL, WorldOptions(truth=truth))
    world.reset(load_task("bipegtransfer").sample_layout(np.random.default_rng(0), "reference"))
    return world


def _go(world: World, axes: FloatArray, periods: int = 200) -> None:
    setpoints = [
        JointSetpoint(tuple(row[:6]), (0.0,) * 6, float(row[6]), 0.0) for row in axes.tolist()
    ]
    for _ in range(periods):
        world.step(setpoints)


def _described_tip(q: FloatArray, turns: FloatArray) -> FloatArray:
    """Where the definitions put PSM1's tip, task frame."""
    arm = with_errors(CELL, {"PSM1": TYPICAL}).arms[0]
    there = q.copy()
    there[3:] += TYPICAL.cables.error(q, turns)
    return np.asarray((arm.T_task_base @ forward_batch(arm.arm, there[None])[0])[:3, 3])


def test_the_tip_is_where_the_truth_says_and_the_encoders_do_not_notice() -> None:
    world = _world(TRUTH)
    axes = world.home.copy()
    axes[0, 3:6] += [-0.2, -0.2, -0.2]
    _go(world, axes)
    axes[0, 3:6] += [0.1, 0.1, 0.1]  # play is taken up: the wrist lags behind
    _go(world, axes)
    q = np.array(world.measured(0).jp)
    np.testing.assert_allclose(q, axes[0, :6], atol=2e-3)  # the servo gives in a little
    tip = world.data.site("PSM1/tip").xpos
    np.testing.assert_allclose(tip, _described_tip(q, np.ones(3)), atol=1e-5)
    nominal = (CELL.arms[0].T_task_base @ forward_batch(CELL.arms[0].arm, q[None])[0])[:3, 3]
    assert np.linalg.norm(tip - nominal) > 3e-3


def test_play_depends_on_the_way_that_the_wrist_came() -> None:
    tips = {}
    for way in (-1.0, 1.0):
        world = _world(TRUTH)
        axes = world.home.copy()
        axes[0, 3:6] -= way * 0.2
        _go(world, axes)
        axes[0, 3:6] += way * 0.2
        _go(world, axes)
        q = np.array(world.measured(0).jp)
        tips[way] = world.data.site("PSM1/tip").xpos.copy()
        np.testing.assert_allclose(tips[way], _described_tip(q, way * np.ones(3)), atol=1e-5)
    assert np.linalg.norm(tips[1.0] - tips[-1.0]) > 1e-4


def test_an_arm_without_errors_is_the_nominal_one() -> None:
    plain, truthful = _world(()), _world((ArmErrors(), ArmErrors()))
    for world in (plain, truthful):
        _go(world, world.home + 0.01, 20)
    np.testing.assert_array_equal(plain.save(), truthful.save())


def test_the_arm_beside_it_is_nominal() -> None:
    world = _world(TRUTH)
    _go(world, world.home)
    q = np.array(world.measured(1).jp)
    there = (CELL.arms[1].T_task_base @ forward_batch(CELL.arms[1].arm, q[None])[0])[:3, 3]
    np.testing.assert_allclose(world.data.site("PSM2/tip").xpos, there, atol=1e-6)


def test_a_truth_about_another_number_of_arms_is_refused() -> None:
    with pytest.raises(ValueError, match="about 1 arms; this cell has 2"):
        World(CELL, WorldOptions(truth=(TYPICAL,)))
