import json
import math
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.core.types import ActiveObject, FloatArray, ObjectPose, Scene
from viskill_deploy.motion.waypoints import downward_pose
from viskill_deploy.sim.closed_loop import ClosedLoop
from viskill_deploy.sim.letters import NAMES
from viskill_deploy.sim.tasks import load_task
from viskill_deploy.sim.tasks import matchboardpanel_script as script
from viskill_deploy.sim.vector_scenes import Scenes

TASK = load_task("matchboardpanel")
GOLDEN = Path(__file__).parents[2] / "golden" / "matchboardpanel_observation.json"
CELL_1_2 = (0.0, 0.025, 0.0038)
"""Middle row, last column: where a letter lies there."""


def pose(x: float, y: float, z: float, yaw: float = 0.0) -> FloatArray:
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, z], [0, 0, 0, 1]], dtype=float)


def shift(x: float, y: float, z: float) -> FloatArray:
    return np.array([x, y, z])


def scene(
    letter: FloatArray, open_m: float = 0.0, name: str = "letterC", goal: FloatArray | None = None
) -> Scene:
    """The letter somewhere, the doors of the row x = 0 open by `open_m`, the others closed."""
    doors = [(-0.025, 0.0), (0.0, open_m), (0.025, 0.0)]
    objects = [ObjectPose(name, letter)]
    objects += [ObjectPose(f"door{i}", pose(x, y, 0.0086)) for i, (x, y) in enumerate(doors)]
    return Scene(0.0, tuple(objects), name, np.array(CELL_1_2) if goal is None else goal)


def start() -> FloatArray:
    entry = TASK.cell.arms[0].entry
    return downward_pose(entry.start_position_m, entry.start_yaw_rad)


def seen(at: Scene, jaw: float = 0.0) -> FloatArray:
    return TASK.observe([start()], [jaw], at)


def any_observations(rng: np.random.Generator, count: int) -> tuple[FloatArray, FloatArray]:
    """Observations and subgoals with numbers of a plausible size, in no plausible order."""
    obs, goal = rng.uniform(-0.15, 0.15, (count, 31)), rng.uniform(-0.15, 0.15, (count, 7))
    obs[:, [3, 4, 5, 16, 17, 18]] = rng.uniform(-math.pi, math.pi, (count, 6))
    obs[:, 6], goal[:, 6] = rng.uniform(-0.1, 0.8, count), 0.0
    near = rng.random(count) < 0.5  # half of them near what they shall touch
    obs[near, 0:3] = obs[near, 13:16] + rng.uniform(-0.003, 0.012, (near.sum(), 3))
    return obs, goal


def test_the_observation_has_the_golden_layout_and_values() -> None:
    golden = json.loads(GOLDEN.read_text(encoding="utf-8"))
    assert [list(entry) for entry in TASK.observation_layout] == golden["layout"]
    obs = seen(scene(pose(0.051, 0.057, 0.00145, 0.3), 0.0123, "letter4"), jaw=0.2)
    assert obs == pytest.approx(golden["observation"], abs=1e-12)


def test_the_observation_says_where_things_are() -> None:
    obs = seen(scene(pose(0.05, 0.055, 0.00145), 0.02), jaw=0.2)
    assert obs.shape == (31,)
    assert obs[0:3] == pytest.approx([-0.07, 0.045, 0.0492])
    assert obs[3:7] == pytest.approx([-math.pi / 2, 0.0, math.pi / 2, 0.2])
    assert obs[7:10] == pytest.approx([0.05, 0.055, 0.00145])
    assert obs[10:13] == pytest.approx(obs[7:10] - obs[0:3])
    assert obs[13:16] == pytest.approx([0.05, 0.0505, 0.00145])  # the C's spine
    assert obs[16:19] == pytest.approx([0.0, 0.0, math.pi / 2])
    assert obs[19:22] == pytest.approx([0.0, 0.02, 0.0086])
    assert obs[22:25] == pytest.approx([0.0, 0.05625, 0.0111])
    assert obs[25:28] == pytest.approx(CELL_1_2)
    assert obs[28:31] == pytest.approx([0.0, 0.03625, 0.0111])


def test_only_the_door_over_the_goal_is_observed() -> None:
    at = scene(pose(0.05, 0.055, 0.00145), 0.02, goal=np.array([0.025, 0.0, 0.0038]))
    obs = seen(at)
    assert obs[19:22] == pytest.approx([0.025, 0.0, 0.0086])
    assert obs[28:31] == pytest.approx([0.025, 0.03625, 0.0111])


def test_many_scenes_at_once_are_observed_as_one_at_a_time() -> None:
    rng = np.random.default_rng(3)
    alone = [TASK.sample_layout(rng, "wide") for _ in range(12)]
    doors = [f"door{i}" for i in range(3)]
    poses = np.tile(np.eye(4), (12, len(NAMES) + 3, 1, 1))
    for row, one in enumerate(alone):
        for thing in one.objects:
            poses[row, (*NAMES, *doors).index(thing.name)] = thing.T_task_object
    many = Scenes(
        np.zeros(12),
        (*NAMES, *doors),
        poses,
        tuple(one.active for one in alone),
        np.array([one.goal for one in alone]),
    )
    tips, jaws = np.array([start()] * 12), rng.uniform(0.0, 0.7, 12)
    together = TASK.observe([tips], [jaws], many)  # type: ignore[arg-type]
    for row, one in enumerate(alone):
        assert np.array_equal(together[row], TASK.observe([start()], [jaws[row]], one))


def test_subgoals_are_those_of_the_scripted_plan() -> None:
    at = scene(pose(0.05, 0.055, 0.00145))
    obs = seen(at)
    goals = TASK.subgoals(obs, at, np.random.default_rng(4))
    rng = np.random.default_rng(4)
    raised, slid = rng.uniform(0.0, 0.004), rng.uniform(0.0, 0.0005)
    opened = [0.0, 0.03625 + 0.075 + slid, 0.0111]
    assert goals["pull"][3:6] == pytest.approx(opened)
    assert goals["pull"][:3] == pytest.approx(np.array(opened) + shift(0, -0.0022, 0.02 + raised))
    lift = np.array([0.0, 0.0, 0.025 + raised])
    assert goals["grasp"][3:6] == pytest.approx(obs[7:10] + lift)
    assert goals["grasp"][:3] == pytest.approx(obs[13:16] + shift(0, 0, 0.0093) + lift)
    assert goals["release"][3:6] == pytest.approx(CELL_1_2)
    above = np.array(CELL_1_2) + shift(0.0, -0.0045, 0.0093) + lift
    assert goals["release"][:3] == pytest.approx(above)
    assert goals["push"][3:6] == pytest.approx([0.0, 0.03625, 0.0111])
    assert goals["push"][:3] == pytest.approx([0.0, 0.03845, 0.0311])
    assert all(goal[6] == 0.0 for goal in goals.values())


def test_of_a_chosen_subgoal_only_what_the_task_leaves_open_is_taken() -> None:
    at = scene(pose(0.05, 0.055, 0.00145))
    obs, chosen = seen(at), np.arange(1.0, 7.0)
    pull = TASK.complete_subgoal("pull", chosen, obs, at)
    assert pull.tolist() == pytest.approx([1, 2, 3, 0.0, 5, 0.0111, 0])
    assert TASK.complete_subgoal("grasp", chosen, obs, at).tolist() == [1, 2, 3, 4, 5, 6, 0]
    release = TASK.complete_subgoal("release", chosen, obs, at)
    assert release.tolist() == pytest.approx([1, 2, 3, *CELL_1_2, 0])
    assert chosen.tolist() == [1, 2, 3, 4, 5, 6]


def test_the_final_subgoal_is_the_closed_door_and_the_jaw_off_its_handle() -> None:
    at = scene(pose(0.05, 0.055, 0.00145), 0.075)
    final = TASK.final_subgoal(seen(at), at)
    assert final == pytest.approx([0.0, 0.03845, 0.0311, 0.0, 0.03625, 0.0111, 0.0])
    goals = TASK.subgoals(seen(at), at, np.random.default_rng(0))
    assert np.array_equal(goals["push"], final)


@pytest.mark.parametrize(("skill", "second"), [("pull", 22), ("grasp", 7), ("release", 7)])
def test_a_skill_counts_as_done_within_5_mm_and_with_the_door_untouched(
    skill: str, second: int
) -> None:
    obs = np.arange(31.0) / 1000
    goal = np.array([*obs[0:3], *obs[second : second + 3], 0.0])
    assert TASK.skill_success(skill, TASK.achieved(skill, obs, (False,)), goal)
    assert not TASK.skill_success(skill, TASK.achieved(skill, obs, (True,)), goal)
    for axis in (0, 4):
        far = goal.copy()
        far[axis] += 0.0051
        assert not TASK.skill_success(skill, TASK.achieved(skill, obs, (False,)), far)


@pytest.mark.parametrize(
    ("letter", "open_m", "speed", "touched", "done"),
    [
        (pose(*CELL_1_2), 0.0, 0.0, False, True),
        (pose(0.004, 0.021, 0.0045), 0.0049, 0.0049, False, True),
        (pose(0.0, 0.025, 0.0038, math.pi / 4), 0.0, 0.0, False, True),
        (pose(0.0, 0.025, 0.0038, math.pi), 0.0, 0.0, False, True),
        (pose(0.0070, 0.025, 0.0038), 0.0, 0.0, False, False),  # over the edge
        (pose(0.0050, 0.025, 0.0038, math.pi / 4), 0.0, 0.0, False, False),
        (pose(0.0, 0.0, 0.0038), 0.0, 0.0, False, False),  # in another cell
        (pose(0.0, 0.025, 0.0050), 0.0, 0.0, False, False),  # not down
        (pose(0.0, 0.025, 0.0113), 0.0, 0.0, False, False),  # on the door
        (pose(*CELL_1_2), 0.0051, 0.0, False, False),  # door ajar
        (pose(*CELL_1_2), 0.0, 0.0051, False, False),  # moving
        (pose(*CELL_1_2), 0.0, 0.0, True, False),  # held
    ],
)
def test_the_task_is_done_when_the_letter_lies_in_its_cell_let_go_behind_a_closed_door(
    letter: FloatArray, open_m: float, speed: float, touched: bool, done: bool
) -> None:
    thing = ActiveObject(letter, speed, (touched,))
    assert TASK.success(thing, scene(letter, open_m)) is done


def test_a_letter_that_leans_on_something_is_not_in_its_cell() -> None:
    leaning = pose(*CELL_1_2)
    c, s = math.cos(0.3), math.sin(0.3)
    leaning[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    assert not TASK.success(ActiveObject(leaning, 0.0, (False,)), scene(leaning))


def test_reference_layouts_are_those_of_the_reference_task() -> None:
    rng, cells = np.random.default_rng(2), Counter[tuple[float, float]]()
    for _ in range(900):
        at = TASK.sample_layout(rng, "reference")
        assert at.active == "letterC"
        x, y, z = at.pose("letterC")[:3, 3]
        assert 0.050 <= x <= 0.052
        assert 0.055 <= y <= 0.059
        assert z == pytest.approx(0.00145, abs=1e-3)
        assert np.array_equal(at.pose("letterC")[:3, :3], np.eye(3))
        assert all(at.pose(f"door{i}")[1, 3] == 0.0 for i in range(3))
        assert at.goal[2] == pytest.approx(0.0038)
        cells[(round(float(at.goal[0]), 6), round(float(at.goal[1]), 6))] += 1
    steps = (-0.025, 0.0, 0.025)
    assert set(cells) == {(x, y) for x in steps for y in steps}
    assert min(cells.values()) > 65


def test_wide_layouts_use_every_letter_and_cell_about_equally() -> None:
    rng = np.random.default_rng(2)
    layouts = [TASK.sample_layout(rng, "wide") for _ in range(900)]
    letters = Counter(at.active for at in layouts)
    assert set(letters) == set(NAMES)
    assert min(letters.values()) > 65
    assert len({tuple(at.goal) for at in layouts}) == 9


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), skill=st.sampled_from(["pull", "grasp", "release", "push"]))
def test_whatever_is_seen_the_script_asks_for_less_than_9_mm_and_30_degrees(
    seed: int, skill: str
) -> None:
    obs, goal = any_observations(np.random.default_rng(seed), 40)
    actions = TASK.scripted_action(skill, obs, goal)
    assert actions.shape == (40, 5)
    assert np.isfinite(actions).all()
    assert np.abs(actions).max() <= 1.0
    assert np.linalg.norm(actions[:, :3], axis=1).max() * TASK.action.displacement_m <= 0.009


@pytest.mark.parametrize("skill", ["pull", "grasp", "release", "push"])
def test_many_states_at_once_get_what_each_gets_alone(skill: str) -> None:
    obs, goal = any_observations(np.random.default_rng(7), 200)
    flags = np.zeros((200, 1))
    actions = TASK.scripted_action(skill, obs, goal)
    reached = TASK.achieved(skill, obs, flags)
    done = TASK.skill_success(skill, reached, goal)
    for row in range(200):
        alone = TASK.scripted_action(skill, obs[row], goal[row])
        assert alone == pytest.approx(actions[row], abs=1e-12)
        one = TASK.achieved(skill, obs[row], (False,))
        assert np.array_equal(one, reached[row])
        assert TASK.skill_success(skill, one, goal[row]) == done[row]


@pytest.mark.parametrize("before_m", [0.004, -0.0006])
def test_the_jaw_rises_off_a_knob_that_it_does_not_stand_behind(before_m: float) -> None:
    at = scene(pose(0.05, 0.055, 0.00145))
    obs = seen(at)
    goal = TASK.subgoals(obs, at, np.random.default_rng(0))["pull"]
    obs[0:3] = obs[22:25] + shift(0.0, before_m, 0.0130)  # going on would jam or drag the door
    action = TASK.scripted_action("pull", obs, goal)
    assert action[:2].tolist() == [0.0, 0.0]
    assert action[2] > 0.5


def test_the_jaw_pushes_a_knob_that_it_stands_behind() -> None:
    at = scene(pose(0.05, 0.055, 0.00145), 0.02)
    obs = seen(at)
    for skill, way in (("pull", 1.0), ("push", -1.0)):
        goal = TASK.subgoals(obs, at, np.random.default_rng(0))[skill]
        obs[0:3] = obs[22:25] + shift(0.0, -0.004 * way, 0.0104)
        action = TASK.scripted_action(skill, obs, goal)
        assert way * action[1] > 0.5
        assert abs(action[2]) < 0.1


def test_a_held_letter_is_never_dropped_on_its_way() -> None:
    at = scene(pose(0.03, 0.02, 0.03))
    obs = seen(at, jaw=0.14)
    obs[0:3] = obs[13:16] + shift(0.0, 0.0, script.GRASP_M)
    goal = TASK.subgoals(obs, at, np.random.default_rng(0))["release"]
    assert TASK.scripted_action("release", obs, goal)[4] < 0
    assert TASK.scripted_action("grasp", obs, goal)[4] < 0


@pytest.mark.parametrize("distribution", ["reference", "wide"])
def test_the_script_puts_the_letter_away_through_the_real_steps(distribution: str) -> None:
    loop = ClosedLoop(TASK)
    for seed in range(3):
        rng = np.random.default_rng([11, seed])
        obs = loop.reset(TASK.sample_layout(rng, distribution))
        goals = TASK.subgoals(obs, loop.world.scene(), rng)
        for skill in TASK.skills:
            for _ in range(skill.budget):
                obs = loop.step(TASK.scripted_action(skill.name, obs, goals[skill.name]), skill)
            reached = TASK.achieved(skill.name, obs, loop.flags())
            assert TASK.skill_success(skill.name, reached, goals[skill.name])
        assert loop.success()


def test_an_episode_takes_as_long_as_the_references() -> None:
    assert [skill.name for skill in TASK.skills] == ["pull", "grasp", "release", "push"]
    assert sum(skill.budget for skill in TASK.skills) == 150


def test_a_cell_without_a_panel_is_refused() -> None:
    with pytest.raises(DataFileError, match="panel"):
        load_task("matchboardpanel", load_cell("bipegtransfer"))
