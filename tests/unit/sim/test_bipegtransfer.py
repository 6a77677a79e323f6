import json
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from viskill_deploy.core.types import ActiveObject, FloatArray, ObjectPose, Scene
from viskill_deploy.motion.waypoints import downward_pose
from viskill_deploy.sim.tasks import load_task
from viskill_deploy.sim.tasks.bipegtransfer import fixed_euler

TASK = load_task("bipegtransfer")
GOLDEN = Path(__file__).parents[2] / "golden" / "bipegtransfer_observation.json"


def pose(x: float, y: float, z: float, yaw: float = 0.0) -> FloatArray:
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, z], [0, 0, 0, 1]], dtype=float)


def scene(x: float, y: float, z: float, yaw: float = 0.0) -> Scene:
    thing = ObjectPose("block2", pose(x, y, z, yaw))
    return Scene(0.0, (thing,), "block2", np.array([0.01, 0.043, 0.00725]))


def start() -> list[FloatArray]:
    entries = [arm.entry for arm in TASK.cell.arms]
    return [downward_pose(e.start_position_m, e.start_yaw_rad) for e in entries]


def test_the_observation_has_the_golden_layout_and_values() -> None:
    golden = json.loads(GOLDEN.read_text(encoding="utf-8"))
    assert [list(entry) for entry in TASK.observation_layout] == golden["layout"]
    seen = TASK.observe(start(), [0.1, 0.6], scene(0.0015, -0.047, 0.00725, 0.3))
    assert seen == pytest.approx(golden["observation"], abs=1e-12)


def test_the_observation_says_where_things_are() -> None:
    seen = TASK.observe(start(), [0.1, 0.6], scene(0.0, 0.0, 0.00725))
    assert seen[0:3] == pytest.approx([-0.05, 0.05, 0.0581])
    assert seen[3:7] == pytest.approx([-math.pi / 2, 0.0, math.pi / 2, 0.1])
    assert seen[13] == 0.6
    assert seen[17:20] == pytest.approx(seen[14:17] - seen[0:3])
    assert seen[20:23] == pytest.approx(seen[14:17] - seen[7:10])
    assert seen[23:26] == pytest.approx([0.003, 0.005196, 0.00725])
    assert seen[28] == pytest.approx(math.radians(-120))
    assert seen[34] == pytest.approx(math.radians(120))


def test_fixed_angles_rebuild_the_rotation() -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        roll, pitch, yaw = rng.uniform([-3, -1.5, -3], [3, 1.5, 3])
        cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
        Rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        Ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        R = pose(0, 0, 0, yaw)[:3, :3] @ Ry @ Rx
        assert fixed_euler(R) == pytest.approx((roll, pitch, yaw))


def test_subgoals_are_those_of_the_scripted_plan() -> None:
    at = scene(-0.0215, -0.046919, 0.00725)
    obs = TASK.observe(start(), [0.0, 0.0], at)
    goals = TASK.subgoals(obs, at, np.random.default_rng(4))
    noise = np.random.default_rng(4).uniform(0.0, 0.008, 3)
    o1, o2, lift = obs[23:26], obs[29:32], np.array([0.0, 0.046919, 0.043])
    up = [0.0, 0.0, 0.015]
    assert goals["grasp"][:3] == pytest.approx(o1 + lift + noise + up)
    assert goals["grasp"][3:5] == pytest.approx(o2[:2])
    assert goals["grasp"][5] == pytest.approx(o2[2] + 0.043 + noise[2])
    assert goals["handover"][:3] == pytest.approx(o2 + lift + noise + up)
    over = at.goal[:2] + o1[:2] - [-0.0215, -0.046919]
    meet = (o1 + lift + noise)[:2]
    assert goals["handover"][3:5] == pytest.approx(meet + 0.3 * (over - meet))
    assert goals["release"][3:6] == pytest.approx(at.goal)
    flags = [goals[name][6:].tolist() for name in ("grasp", "handover", "release")]
    assert flags == [[0, 1], [1, 0], [0, 0]]


def test_a_skill_counts_as_done_within_5_mm_and_with_the_right_contacts() -> None:
    obs = np.arange(35.0) / 1000
    goal = np.array([*obs[0:3], *obs[7:10], 0.0, 1.0])
    assert TASK.skill_success("grasp", TASK.achieved("grasp", obs, (False, True)), goal)
    assert not TASK.skill_success("grasp", TASK.achieved("grasp", obs, (True, True)), goal)
    goal[0] += 0.006
    assert not TASK.skill_success("grasp", TASK.achieved("grasp", obs, (False, True)), goal)


def test_the_release_skill_is_judged_by_the_block_alone() -> None:
    obs = np.zeros(35)
    obs[14:17] = 0.01, 0.043, 0.00725
    goal = np.array([0.05, 0.0, 0.07, 0.01, 0.043, 0.00725, 0.0, 0.0])
    assert TASK.skill_success("release", TASK.achieved("release", obs, (False, False)), goal)
    assert not TASK.skill_success("release", TASK.achieved("release", obs, (True, False)), goal)


@pytest.mark.parametrize(
    ("place", "speed", "touched", "done"),
    [
        ((0.010, 0.043, 0.00725), 0.0, (False, False), True),
        ((0.0149, 0.043, 0.0102), 0.0049, (False, False), True),
        ((0.0151, 0.043, 0.00725), 0.0, (False, False), False),
        ((0.010, 0.043, 0.0103), 0.0, (False, False), False),
        ((0.010, 0.043, 0.00725), 0.006, (False, False), False),
        ((0.010, 0.043, 0.00725), 0.0, (True, False), False),
        ((0.010, 0.043, 0.00725), 0.0, (False, True), False),
    ],
)
def test_the_task_is_done_when_the_block_stands_untouched_on_its_peg(
    place: tuple[float, float, float], speed: float, touched: tuple[bool, bool], done: bool
) -> None:
    thing = ActiveObject(pose(*place), speed, touched)
    assert TASK.success(thing, scene(*place)) is done


def test_the_script_does_not_change_its_mind_about_the_same_state() -> None:
    rng = np.random.default_rng(0)
    layout = TASK.sample_layout(rng, "wide")
    obs = TASK.observe(start(), [0.0, 0.0], layout)
    goal = TASK.subgoals(obs, layout, rng)["grasp"]
    actions = [TASK.scripted_action("grasp", obs, goal) for _ in range(3)]
    assert np.array_equal(actions[0], actions[1])
    assert np.array_equal(actions[0], actions[2])
    assert np.abs(actions[0]).max() <= 1.0


@settings(max_examples=200, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    skill=st.sampled_from(["grasp", "handover", "release"]),
)
def test_whatever_is_seen_the_script_asks_for_less_than_9_mm_and_30_degrees(
    seed: int, skill: str
) -> None:
    rng = np.random.default_rng(seed)
    obs, goal = rng.uniform(-0.2, 0.2, 35), rng.uniform(-0.2, 0.2, 8)
    obs[[3, 4, 5, 10, 11, 12, 26, 27, 28, 32, 33, 34]] = rng.uniform(-math.pi, math.pi, 12)
    obs[[6, 13]] = rng.uniform(-0.1, 0.8, 2)
    action = TASK.scripted_action(skill, obs, goal).reshape(2, 5)
    assert np.isfinite(action).all()
    assert np.abs(action).max() <= 1.0
    assert np.linalg.norm(action[:, :3], axis=1).max() * TASK.action.displacement_m <= 0.009


def test_the_script_never_opens_a_jaw_that_its_skill_may_not_open() -> None:
    handover = next(skill for skill in TASK.skills if skill.name == "handover")
    assert handover.may_open_jaw == (False, True)
    obs = TASK.observe(start(), [0.2, 0.6], scene(0.0, 0.0, 0.04))
    obs[0:3] = obs[23:26] + np.array([0.0, 0.0, 0.0132])  # PSM1 holds the block
    goal = np.array([0.0, 0.0, 0.07, 0.01, 0.02, 0.05, 1.0, 0.0])
    assert TASK.scripted_action("handover", obs, goal)[4] < 0


def test_chosen_positions_get_the_contacts_that_the_skill_ends_with() -> None:
    obs, layout = np.arange(35.0), TASK.sample_layout(np.random.default_rng(0), "reference")
    assert TASK.complete_subgoal("handover", np.arange(6.0), obs, layout).tolist() == [
        *range(6),
        1,
        0,
    ]
    final = TASK.final_subgoal(obs, layout)
    assert final.tolist() == [7, 8, 9, *layout.goal.tolist(), 0, 0]
