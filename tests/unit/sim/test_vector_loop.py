from collections.abc import Sequence

import numpy as np
import pytest

from viskill_deploy.core.errors import KinematicsError, MotionError, ViskillError
from viskill_deploy.core.types import FloatArray, Scene
from viskill_deploy.sim import vector_task
from viskill_deploy.sim.closed_loop import ClosedLoop
from viskill_deploy.sim.tasks import SkillSpec, Task, load_task
from viskill_deploy.sim.vector_loop import VectorLoop
from viskill_deploy.sim.world import World, WorldOptions

TASK = load_task("bipegtransfer")
SKILLS = TASK.skills
ROUNDING = 1e-7
"""Kinematics side by side round differently, by 1e-16. In contact that grows to what the solver of
contacts leaves open: seen up to 2e-9 in whole episodes, 6e-12 with a solver tolerance of 1e-8."""

CREEP_M = 1e-7
"""A block that slept is awake for ten physics steps after its moment is restored."""


class Unbatched:
    """The task as its author would write it for one environment."""

    batched = False

    def __init__(self, task: Task) -> None:
        self._task = task

    def __getattr__(self, name: str) -> object:
        return getattr(self._task, name)


def layouts(seeds: Sequence[int], distribution: str = "wide") -> dict[int, Scene]:
    return {
        index: TASK.sample_layout(np.random.default_rng(seed), distribution)
        for index, seed in enumerate(seeds)
    }


def subgoals(loop: VectorLoop, seeds: Sequence[int]) -> list[dict[str, FloatArray]]:
    rows = zip(loop.observe(), loop.scenes(), seeds, strict=True)
    return [TASK.subgoals(obs, scene, np.random.default_rng(seed)) for obs, scene, seed in rows]


def script(loop: VectorLoop, skill: SkillSpec, goals: list[dict[str, FloatArray]]) -> FloatArray:
    names = [skill.name] * loop.count
    wanted = np.array([goal[skill.name] for goal in goals])
    return vector_task.scripted_actions(TASK, names, loop.observe(), wanted)


def start(seeds: Sequence[int]) -> tuple[VectorLoop, list[dict[str, FloatArray]]]:
    loop = VectorLoop(TASK, len(seeds))
    loop.reset(layouts(seeds))
    return loop, subgoals(loop, seeds)


def advance(
    loop: VectorLoop, goals: list[dict[str, FloatArray]], skill: SkillSpec, steps: int
) -> None:
    for _ in range(steps):
        assert loop.step(script(loop, skill, goals), [skill] * loop.count).all()


def test_whole_scripted_episodes_equal_those_of_the_closed_loop() -> None:
    seeds = (0, 1)
    loop, goals = start(seeds)
    alone = [ClosedLoop(TASK) for _ in seeds]
    seen = [one.reset(scene) for one, scene in zip(alone, layouts(seeds).values(), strict=True)]
    for skill in SKILLS:
        for _ in range(skill.budget):
            advance(loop, goals, skill, 1)
            for index, one in enumerate(alone):
                action = TASK.scripted_action(skill.name, seen[index], goals[index][skill.name])
                seen[index] = one.step(action, skill)
                assert loop.stretch[index] == one.stretch
            assert loop.observe() == pytest.approx(np.array(seen), abs=ROUNDING)
        flags = [one.flags() for one in alone]
        assert np.array_equal(loop.flags(), np.array(flags, dtype=float))
    assert loop.success().all()
    assert all(one.success() for one in alone)


def test_without_bystanders_episodes_are_the_same_while_nothing_touches_one() -> None:
    """Layouts with different active blocks, one of them restored into another environment."""
    seeds = (0, 1, 2, 4)
    loop, goals = start(seeds)
    assert len({scene.active for scene in loop.scenes()}) > 1
    lean = VectorLoop(TASK, len(seeds), bystanders=False)
    lean.reset(layouts(seeds))
    for skill in SKILLS:
        for _ in range(skill.budget):
            advance(loop, goals, skill, 1)
            advance(lean, goals, skill, 1)
        assert lean.observe() == pytest.approx(loop.observe(), abs=ROUNDING)
        assert np.array_equal(lean.flags(), loop.flags())
    assert lean.success().all()
    moment, seen = lean.save(0), lean.observe()[0]
    lean.restore({3: moment})
    assert np.array_equal(lean.observe()[3], seen)
    assert lean.scenes()[3].active == lean.scenes()[0].active
    for one, other in zip(lean.scenes()[3].objects, loop.scenes()[0].objects, strict=True):
        assert one.T_task_object == pytest.approx(other.T_task_object, abs=2e-3)


def test_a_thing_that_the_world_does_not_have_is_refused() -> None:
    scene = Scene(0.0, (), "needle", np.zeros(3))
    for bystanders in (True, False):
        with pytest.raises(ViskillError, match="block0"):
            VectorLoop(TASK, 1, bystanders=bystanders).reset({0: scene})


def test_episodes_do_not_depend_on_their_neighbours_or_their_number() -> None:
    (many, goals), (single, goal) = start((4, 5, 6)), start((5,))
    for _ in range(12):
        advance(many, goals, SKILLS[0], 1)
        advance(single, goal, SKILLS[0], 1)
    assert many.observe()[1] == pytest.approx(single.observe()[0], abs=1e-12)


def test_an_episode_goes_on_from_a_saved_moment_in_any_environment() -> None:
    loop, goals = start((1, 2))
    advance(loop, goals, SKILLS[0], 30)  # the block is held
    moment, seen, flags = loop.save(0), loop.observe()[0], loop.flags()[0]
    advance(loop, goals, SKILLS[0], 10)
    later = loop.observe()[0]
    other, _ = start((7, 8, 9))
    other.restore({2: moment})
    assert np.array_equal(other.observe()[2], seen)
    assert np.array_equal(other.flags()[2], flags)
    advance(other, [goals[0]] * 3, SKILLS[0], 10)
    assert other.observe()[2] == pytest.approx(later, abs=ROUNDING)
    assert other.scenes()[2].active == loop.scenes()[0].active
    assert np.array_equal(other.goals()[2], loop.goals()[0])


def test_a_saved_moment_does_not_change_when_its_episode_goes_on() -> None:
    loop, goals = start((1,))
    advance(loop, goals, SKILLS[0], 2)
    moment, seen = loop.save(0), loop.observe()
    advance(loop, goals, SKILLS[0], 5)
    for _ in range(2):
        loop.restore({0: moment})
        assert np.array_equal(loop.observe(), seen)
        advance(loop, goals, SKILLS[0], 3)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_action_that_cannot_be_followed_stops_its_environment_alone(bad: float) -> None:
    (loop, goals), (alone, goal) = start((1, 2)), start((2,))
    actions = script(loop, SKILLS[0], goals)
    actions[0, 3] = bad
    assert loop.step(actions, [SKILLS[0]] * 2).tolist() == [False, True]
    advance(alone, goal, SKILLS[0], 1)
    still = loop.observe()[0]
    for _ in range(3):
        loop.step(script(loop, SKILLS[0], goals), [SKILLS[0]] * 2)
        advance(alone, goal, SKILLS[0], 1)
    assert loop.alive.tolist() == [False, True]
    assert np.array_equal(loop.observe()[0], still)
    assert loop.observe()[1] == pytest.approx(alone.observe()[0], abs=1e-12)
    loop.reset({0: layouts((3,))[0]})
    assert loop.step(np.zeros((2, 10)), [SKILLS[0]] * 2).all()


def test_an_environment_dies_where_the_closed_loop_would_raise() -> None:
    """Turning on and on brings the roll to its end."""
    loop, _ = start((1, 2))
    alone = ClosedLoop(TASK)
    alone.reset(layouts((1,))[0])
    actions = np.zeros((2, 10))
    actions[:, 4::5] = -0.5
    actions[0, 3] = 1.0
    steps = 0
    while loop.alive[0]:
        loop.step(actions, [SKILLS[0]] * 2)
        steps += 1
        assert steps < 40
    for _ in range(steps - 1):
        alone.step(actions[0], SKILLS[0])
    with pytest.raises((KinematicsError, MotionError)):
        alone.step(actions[0], SKILLS[0])
    assert loop.alive.tolist() == [False, True]


def test_environments_run_different_skills_in_the_same_step() -> None:
    loop, goals = start((1, 2))
    names = [SKILLS[0].name, SKILLS[2].name]
    wanted = np.array([goal[name] for goal, name in zip(goals, names, strict=True)])
    seen = loop.observe()
    mixed = vector_task.scripted_actions(TASK, names, seen, wanted)
    for index, name in enumerate(names):
        alone = TASK.scripted_action(name, seen[index], wanted[index])
        assert mixed[index] == pytest.approx(alone, abs=1e-15)
    assert loop.step(mixed, [SKILLS[0], SKILLS[2]]).all()
    reached = vector_task.achieved(TASK, names, loop.observe(), loop.flags())
    assert np.array_equal(reached[1, 3:6], loop.observe()[1, 14:17])


def test_a_task_for_one_environment_gives_the_same_as_a_batched_one() -> None:
    plain = Unbatched(TASK)
    loops = [VectorLoop(task, 2) for task in (TASK, plain)]  # type: ignore[list-item]
    for loop in loops:
        loop.reset(layouts((3, 4)))
    batched, single = (loop.observe() for loop in loops)
    assert batched == pytest.approx(single, abs=1e-15)
    wanted = np.array([goal["grasp"] for goal in subgoals(loops[0], (3, 4))])
    for function in (vector_task.scripted_actions, vector_task.achieved):
        second = wanted if function is vector_task.scripted_actions else wanted[:, 6:]
        pair = [function(task, ["grasp"] * 2, batched, second) for task in (TASK, plain)]  # type: ignore[arg-type]
        assert pair[0] == pytest.approx(pair[1], abs=1e-15)


def test_setpoints_may_take_effect_later() -> None:
    options = WorldOptions(delay_periods=3)
    loop, alone = VectorLoop(TASK, 1, options), ClosedLoop(TASK, World(TASK.cell, options))
    loop.reset(layouts((1,)))
    alone.reset(layouts((1,))[0])
    action = np.full(10, 0.3)
    for _ in range(3):
        loop.step(action[None], [SKILLS[0]])
        seen = alone.step(action, SKILLS[0])
    assert loop.observe()[0] == pytest.approx(seen, abs=ROUNDING)
    loop.restore({0: loop.save(0)})
    loop.step(action[None], [SKILLS[0]])
    seen = alone.step(action, SKILLS[0])
    assert loop.observe()[0] == pytest.approx(seen, abs=CREEP_M)


def test_episodes_may_start_with_the_arms_elsewhere() -> None:
    loop, alone = VectorLoop(TASK, 1), ClosedLoop(TASK)
    axes = alone.world.home + np.array([0.02, -0.02, 0.005, 0.1, 0.05, -0.05, 0.3])
    loop.reset(layouts((1,)), {0: axes})
    alone.reset(layouts((1,))[0], axes)
    loop.step(np.full((1, 10), 0.2), [SKILLS[0]])
    seen = alone.step(np.full(10, 0.2), SKILLS[0])
    assert loop.observe()[0] == pytest.approx(seen, abs=ROUNDING)
    assert loop.waypoint(0).jaw == alone.waypoint.jaw


def test_noise_is_refused() -> None:
    with pytest.raises(ValueError, match="without noise"):
        VectorLoop(TASK, 1, WorldOptions(joint_noise_rad=1e-4))


def test_one_skill_is_needed_an_environment() -> None:
    loop, _ = start((1, 2))
    with pytest.raises(ValueError, match="one each"):
        loop.step(np.zeros((2, 10)), [SKILLS[0]])
