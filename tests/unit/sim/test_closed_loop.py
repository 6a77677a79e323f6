import numpy as np
import pytest

from viskill_deploy.core.types import FloatArray
from viskill_deploy.motion.resolve import task_poses
from viskill_deploy.motion.smoothing import passing_velocity
from viskill_deploy.sim.closed_loop import ClosedLoop
from viskill_deploy.sim.tasks import load_task

TASK = load_task("bipegtransfer")


def episode(loop: ClosedLoop, seed: int, distribution: str) -> tuple[bool, FloatArray, list[bool]]:
    """Runs the script; returns success, the last observation, and each skill's success."""
    rng = np.random.default_rng(seed)
    obs = loop.reset(TASK.sample_layout(rng, distribution))
    goals, reached = TASK.subgoals(obs, loop.world.scene(), rng), []
    for skill in TASK.skills:
        goal = goals[skill.name]
        for _ in range(skill.budget):
            obs = loop.step(TASK.scripted_action(skill.name, obs, goal), skill)
        achieved = TASK.achieved(skill.name, obs, loop.flags())
        reached.append(TASK.skill_success(skill.name, achieved, goal))
    return loop.success(), obs, reached


@pytest.mark.parametrize("distribution", ["reference", "wide"])
def test_the_script_transfers_the_block_through_the_real_steps(distribution: str) -> None:
    loop = ClosedLoop(TASK)
    for seed in range(4):
        done, _, reached = episode(loop, seed, distribution)
        assert done
        assert reached == [True, True, True]


def test_the_same_seed_gives_the_same_episode_bit_by_bit() -> None:
    used, fresh = ClosedLoop(TASK), ClosedLoop(TASK)
    episode(used, 7, "wide")
    _, first, _ = episode(used, 3, "wide")
    _, second, _ = episode(fresh, 3, "wide")
    assert np.array_equal(first, second)


def test_a_step_brings_the_tip_to_the_waypoint_it_asked_for() -> None:
    loop = ClosedLoop(TASK)
    obs = loop.reset(TASK.sample_layout(np.random.default_rng(0), "reference"))
    action = np.zeros(10)
    action[[0, 4, 7, 9]] = 0.5, -0.5, -0.3, -0.5
    skill = TASK.skills[0]
    after = loop.step(action, skill)
    assert after[0:3] - obs[0:3] == pytest.approx([0.005, 0.0, 0.0], abs=3e-4)
    assert after[7:10] - obs[7:10] == pytest.approx([0.0, 0.0, -0.003], abs=3e-4)


def test_a_jaw_that_is_told_to_close_stays_at_its_grip_angle() -> None:
    loop = ClosedLoop(TASK)
    loop.reset(TASK.sample_layout(np.random.default_rng(0), "reference"))
    action = np.zeros(10)
    action[[4, 9]] = 0.5, -0.5
    segment = loop.plan(action, TASK.skills[0])
    end = segment.at(segment.duration_s)
    assert end[0].p[6] == pytest.approx(TASK.action.jaw_open_rad)
    assert end[1].p[6] == pytest.approx(TASK.cell.arms[1].arm.jaw.grip_angle_rad)
    assert segment.stretch > 1.0  # the jaw needs longer than a step


def test_waypoints_are_passed_with_the_speed_of_the_displacement() -> None:
    loop = ClosedLoop(TASK)
    loop.reset(TASK.sample_layout(np.random.default_rng(0), "reference"))
    action = np.zeros(10)
    action[[0, 4, 9]] = 0.5, -0.5, -0.5
    segment = loop.plan(action, TASK.skills[0])
    table = segment.table(0.004)[0][-2:, 0, :6]
    tips = task_poses(TASK.cell, 0, table)[:, :3, 3]
    assert (tips[1] - tips[0])[0] / 0.004 == pytest.approx(0.005 / 0.2, rel=0.1)
    motion = segment.at(segment.duration_s)
    rows = passing_velocity(motion, np.array([m.p for m in motion]) + 0.1, 0.2)
    assert rows[0] == pytest.approx([0.5] * 6 + [0.0])
