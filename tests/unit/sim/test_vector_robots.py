"""Environments may each have a hidden robot, which goes with a moment that is saved."""

from dataclasses import replace

import numpy as np
import pytest

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.closed_loop import ClosedLoop
from viskill_deploy.sim.tasks import load_task
from viskill_deploy.sim.vector_loop import VectorLoop
from viskill_deploy.sim.world import World, WorldOptions
from viskill_deploy.train.hidden import HiddenSettings, hidden_robots
from viskill_deploy.train.rollout import Start
from viskill_deploy.train.settings import RunSettings, settings_facts

TASK = load_task("bipegtransfer")
CELL = load_cell("bipegtransfer")
ROBOTS = hidden_robots(CELL, HiddenSettings(0.3, seed=7), 2)
UNSEEN = tuple(
    replace(robot, object_error_m=(0.0, 0.0, 0.0), object_error_rad=0.0) for robot in ROBOTS
)
LAYOUT = TASK.sample_layout(np.random.default_rng(0), "reference")
GRASP = TASK.skills[0]


def _loop(robots: tuple[WorldOptions, ...], bystanders: bool = False) -> VectorLoop:
    loop = VectorLoop(TASK, 2, bystanders=bystanders, robots=robots)
    loop.reset({0: LAYOUT, 1: LAYOUT})
    return loop


def _action(obs: FloatArray) -> FloatArray:
    goal = TASK.subgoals(obs, LAYOUT, np.random.default_rng(1))[GRASP.name]
    return TASK.scripted_action(GRASP.name, obs, goal)


def _steps(loop: VectorLoop, count: int) -> FloatArray:
    for _ in range(count):
        obs = loop.observe()
        assert loop.step(np.array([_action(row) for row in obs]), [GRASP] * 2).all()
    return loop.observe()


@pytest.mark.parametrize("bystanders", [False, True])
def test_each_environment_does_as_its_robot_would_alone(bystanders: bool) -> None:
    loop = _loop(UNSEEN, bystanders)
    alone = [ClosedLoop(TASK, World(CELL, robot)) for robot in UNSEEN]
    seen = [one.reset(LAYOUT) for one in alone]
    for _ in range(12):
        np.testing.assert_allclose(loop.observe(), seen, atol=1e-7)
        seen = [one.step(_action(obs), GRASP) for one, obs in zip(alone, seen, strict=True)]
        _steps(loop, 1)
    tips = [one.world.tips() for one in alone]
    assert np.linalg.norm(tips[0] - tips[1], axis=1).max() > 5e-4, "the same way, other places"


def test_the_same_seed_gives_the_same_robots_and_the_same_bits() -> None:
    first, again = _steps(_loop(ROBOTS), 3), _steps(_loop(ROBOTS), 3)
    np.testing.assert_array_equal(first, again)
    others = hidden_robots(CELL, HiddenSettings(0.3, seed=8), 2)
    assert not np.array_equal(_steps(_loop(others), 3), first)
    assert hidden_robots(CELL, HiddenSettings(0.3, seed=8), 1)[0] == ROBOTS[1]


def test_things_are_seen_wrongly_by_what_robot_and_layout_say() -> None:
    loop = _loop(ROBOTS)
    plain, wrong = _loop(UNSEEN).scenes(), loop.scenes()
    name = LAYOUT.active
    off = [w.pose(name)[:3, 3] - p.pose(name)[:3, 3] for w, p in zip(wrong, plain, strict=True)]
    assert 1e-5 < np.linalg.norm(off[0]) < 1e-3
    assert not np.array_equal(off[0], off[1])
    loop.reset({0: LAYOUT})
    np.testing.assert_array_equal(loop.scenes()[0].pose(name), wrong[0].pose(name))


def test_a_moment_goes_on_with_its_robot_in_another_environment() -> None:
    loop = _loop(ROBOTS)
    _steps(loop, 4)
    saved = loop.save(1)
    assert saved.robot == 1
    there = _steps(loop, 3)[1]
    loop.restore({0: saved})
    here = _steps(loop, 3)[0]
    np.testing.assert_allclose(here, there, atol=1e-7)
    loop.restore({0: saved, 1: saved})
    rows = loop.observe()
    np.testing.assert_array_equal(rows[0], rows[1])


def test_noise_and_delay_are_refused() -> None:
    noisy = replace(ROBOTS[0], joint_noise_rad=1e-4)
    with pytest.raises(ValueError, match="noise"):
        VectorLoop(TASK, 1, robots=(noisy,))


def test_learning_is_without_hidden_robots_and_says_nothing_of_them_unless_asked() -> None:
    assert hidden_robots(CELL, HiddenSettings(), 4) == ()
    assert "hidden" not in settings_facts(RunSettings())
    asked = settings_facts(RunSettings(hidden=HiddenSettings(0.2)))
    assert asked["hidden"] == {"scale": 0.2, "seed": 0}
    with pytest.raises(ValueError, match="scale"):
        HiddenSettings(1.5)


def test_a_moment_that_was_stored_before_there_were_robots_is_one_without() -> None:
    loop = _loop(())
    tree = Start(loop.save(0), np.zeros((3, 8))).tree()
    del tree["robot"], tree["hidden"]
    there = _steps(loop, 3)[0]
    loop.restore({0: Start.of(tree).state})
    np.testing.assert_allclose(_steps(loop, 3)[0], there, atol=1e-7)
