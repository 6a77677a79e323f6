import math
from collections import Counter
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from viskill_deploy.core.description import load_cell, rpy_matrix
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.core.types import ActiveObject, FloatArray, ObjectPose, Scene
from viskill_deploy.kinematics.closed_form import inverse_batch
from viskill_deploy.motion.limits import PlanLimits
from viskill_deploy.motion.resolve import base_poses
from viskill_deploy.motion.waypoints import (
    WORKSPACE_INSET_M,
    downward_pose,
    pitched_pose,
    start_waypoint,
)
from viskill_deploy.sim.closed_loop import ClosedLoop
from viskill_deploy.sim.tasks import load_task
from viskill_deploy.sim.tasks.bipegboard import fixed_euler
from viskill_deploy.sim.world import World

TASK = load_task("bipegboard")
START = list(start_waypoint(TASK.cell).T_task_tip)
GOAL_PEG = (0.0, 0.037)


def pose(x: float, y: float, z: float, R: FloatArray | None = None) -> FloatArray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.eye(3) if R is None else R, (x, y, z)
    return T


def scene(*place: float, R: FloatArray | None = None) -> Scene:
    thing = ObjectPose("ring1", pose(*place, R))
    return Scene(0.0, (thing,), "ring1", np.array([*GOAL_PEG, 0.00115]))


def episode(loop: ClosedLoop, seed: int, distribution: str, noise: float = 0.0) -> list[bool]:
    """Runs the script; returns each skill's success, and the task's."""
    rng = np.random.default_rng(seed)
    obs = loop.reset(TASK.sample_layout(rng, distribution))
    goals, reached = TASK.subgoals(obs, loop.world.scene(), rng), []
    for skill in TASK.skills:
        goal = goals[skill.name]
        for _ in range(skill.budget):
            nudge = rng.normal(0.0, noise, 10) * np.array([1.0, 1.0, 1.0, 1.0, 0.0] * 2)
            obs = loop.step(TASK.scripted_action(skill.name, obs, goal) + nudge, skill)
        achieved = TASK.achieved(skill.name, obs, loop.flags())
        reached.append(bool(TASK.skill_success(skill.name, achieved, goal)))
    return [*reached, loop.success()]


@pytest.mark.parametrize("distribution", ["reference", "wide"])
def test_the_script_lays_the_ring_over_its_peg_through_the_real_steps(distribution: str) -> None:
    loop = ClosedLoop(TASK)
    for seed in range(4):
        assert episode(loop, seed, distribution) == [True] * 4


def test_the_script_recovers_from_actions_that_are_a_millimetre_off() -> None:
    loop = ClosedLoop(TASK)
    assert sum(episode(loop, seed, "wide", noise=0.1)[-1] for seed in range(8)) >= 6


def test_every_place_of_the_workspace_is_in_reach_with_the_wrist_past_the_cannula() -> None:
    turns = (np.linspace(-math.pi / 2, math.pi / 2, 7), np.linspace(-math.pi / 3, math.pi / 3, 5))
    for index, (arm, angles) in enumerate(zip(TASK.cell.arms, turns, strict=True)):
        low = np.array(arm.entry.workspace_lower_m) + WORKSPACE_INSET_M
        high = np.array(arm.entry.workspace_upper_m) - WORKSPACE_INSET_M
        places = product(*(np.linspace(a, b, 5) for a, b in zip(low, high, strict=True)))
        make = pitched_pose if arm.entry.rotation == "pitch" else downward_pose
        poses = np.array([make(place, a) for place, a in product(places, angles)])
        seeds = np.zeros((len(poses), 6))
        q, reached = inverse_batch(arm.arm, base_poses(TASK.cell, index, poses), seeds)
        assert reached.all()
        limits = PlanLimits.of(arm.arm)
        assert (q > limits.lower[:6]).all()
        assert (q < limits.upper[:6]).all()


def test_the_observation_says_where_things_are() -> None:
    seen = TASK.observe(START, [0.1, 0.6], scene(-0.07, -0.04, 0.0655))
    psm1, psm2 = (arm.entry for arm in TASK.cell.arms)
    assert seen[0:3] == pytest.approx(psm1.start_position_m)
    assert seen[3:7] == pytest.approx([math.radians(-15), 0.0, -math.pi, 0.1])
    assert seen[7:10] == pytest.approx(psm2.start_position_m)
    assert seen[10:14] == pytest.approx([-math.pi / 2, 0.0, 0.0, 0.6])
    assert seen[14:17] == pytest.approx([-0.07, -0.04, 0.0655])
    assert seen[17:20] == pytest.approx(seen[14:17] - seen[0:3])
    assert seen[20:23] == pytest.approx(seen[14:17] - seen[7:10])
    assert seen[23:26] - seen[14:17] == pytest.approx([0.0, 0.0156, 0.0])
    assert seen[29:32] - seen[14:17] == pytest.approx([0.0, -0.0056, 0.0149])
    assert seen[26:29] == pytest.approx([0.0, 0.0, math.pi / 2])
    assert seen[32:35] == pytest.approx(seen[26:29])


def test_angles_stay_continuous_from_the_hanging_to_the_lying_ring() -> None:
    """The ring turns about y with PSM1's pitch; no angle but the first may move."""
    for pitch in np.linspace(0.0, math.pi / 2, 20):
        R = rpy_matrix(0.0, -pitch, 0.0)
        seen = TASK.observe(START, [0.0, 0.0], scene(0.0, 0.0, 0.05, R=R))
        assert seen[26:29] == pytest.approx([-pitch, 0.0, math.pi / 2], abs=1e-9)


@pytest.mark.parametrize("yaw", [-math.pi - 0.1, -math.pi, -math.pi + 0.1])
def test_psm1s_yaw_does_not_jump_by_a_turn(yaw: float) -> None:
    assert fixed_euler(rpy_matrix(-0.3, 0.7, yaw), -math.pi) == pytest.approx((-0.3, 0.7, yaw))


def test_subgoals_are_those_of_the_scripted_plan() -> None:
    at = scene(-0.0703, -0.01295, 0.0655)
    obs = TASK.observe(START, [0.0, 0.0], at)
    goals = TASK.subgoals(obs, at, np.random.default_rng(4))
    noise = np.random.default_rng(4).uniform(0.0, 0.008, 3)
    o1, o2 = obs[23:26], obs[29:32]
    meet1 = np.array([o1[0] + 0.03, 0.009, o1[2]]) + noise
    meet2 = np.array([o2[0] + 0.03, -0.009, o2[2] + 0.004]) + noise
    waiting = [meet1[0], max(meet1[1], -0.01295 + 0.022), meet1[2]]
    assert goals["grasp"][:3] == pytest.approx(waiting)
    assert goals["grasp"][3:6] == pytest.approx([meet2[0], o2[1], o2[2] + 0.004])
    assert goals["handover"][:3] == pytest.approx(meet2)
    assert goals["handover"][3:6] == pytest.approx(meet1 + np.array([0.0, 0.02, 0.0]))
    assert goals["release"][3:6] == pytest.approx(at.goal)
    flags = [goals[name][6:].tolist() for name in ("grasp", "handover", "release")]
    assert flags == [[0, 1], [1, 0], [0, 0]]


def test_psm1_waits_clear_of_a_ring_that_hangs_on_its_side() -> None:
    for y in (-0.06475, 0.01295, 0.03885):
        at = scene(-0.0703, y, 0.0655)
        obs = TASK.observe(START, [0.0, 0.0], at)
        waiting = TASK.subgoals(obs, at, np.random.default_rng(0))["grasp"][1]
        fingers = waiting - TASK.cell.arms[0].arm.jaw.finger_length_m
        assert fingers > y + 0.0095


@pytest.mark.parametrize(
    ("place", "speed", "touched", "done"),
    [
        ((0.0, 0.037, 0.00115), 0.0, (False, False), True),
        ((0.0049, 0.037, 0.0031), 0.0049, (False, False), True),
        ((0.0051, 0.037, 0.00115), 0.0, (False, False), False),
        ((0.0, 0.037, 0.0032), 0.0, (False, False), False),
        ((0.0, -0.037, 0.00115), 0.0, (False, False), False),
        ((0.0, 0.037, 0.00115), 0.006, (False, False), False),
        ((0.0, 0.037, 0.00115), 0.0, (True, False), False),
        ((0.0, 0.037, 0.00115), 0.0, (False, True), False),
    ],
)
def test_the_task_is_done_when_the_ring_lies_untouched_around_its_peg(
    place: tuple[float, float, float], speed: float, touched: tuple[bool, bool], done: bool
) -> None:
    assert TASK.success(ActiveObject(pose(*place), speed, touched), scene(*place)) is done


def test_a_skill_is_judged_by_the_subgoal_that_it_was_given() -> None:
    obs = np.arange(35.0) / 1000
    goal = np.array([*obs[0:3], *obs[7:10], 0.0, 1.0])
    achieved = TASK.achieved("grasp", obs, (False, True))
    assert TASK.skill_success("grasp", achieved, goal)
    assert not TASK.skill_success("grasp", TASK.achieved("grasp", obs, (True, True)), goal)
    goal[0] += 0.006
    assert not TASK.skill_success("grasp", achieved, goal)
    last = np.array([9.0, 9.0, 9.0, *obs[14:17], 0.0, 0.0])
    assert TASK.skill_success("release", TASK.achieved("release", obs, (False, False)), last)


def test_chosen_positions_get_the_contacts_that_the_skill_ends_with() -> None:
    obs, layout = np.arange(35.0), TASK.sample_layout(np.random.default_rng(0), "reference")
    chosen = TASK.complete_subgoal("handover", np.arange(6.0), obs, layout)
    assert chosen.tolist() == [*range(6), 1, 0]
    final = TASK.final_subgoal(obs, layout)
    assert final.tolist() == [7, 8, 9, *layout.goal.tolist(), 0, 0]


def random_states(seed: int, count: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    obs, goal = rng.uniform(-0.2, 0.2, (count, 35)), rng.uniform(-0.2, 0.2, (count, 8))
    turns = [3, 4, 5, 10, 11, 12, 26, 27, 28, 32, 33, 34]
    obs[:, turns] = rng.uniform(-math.pi, math.pi, (count, 12))
    obs[:, [6, 13]] = rng.uniform(-0.1, 0.8, (count, 2))
    held = rng.random(count) < 0.5
    obs[held, 0:3] = obs[held, 23:26] + rng.normal(0.0, 0.002, (held.sum(), 3))
    obs[held, 7:10] = obs[held, 29:32] + rng.normal(0.0, 0.002, (held.sum(), 3))
    return obs, goal


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), skill=st.sampled_from([skill.name for skill in TASK.skills]))
def test_whatever_is_seen_the_script_asks_for_small_steps_and_the_same_for_one_or_many(
    seed: int, skill: str
) -> None:
    obs, goal = random_states(seed, 16)
    actions = TASK.scripted_action(skill, obs, goal)
    assert actions.shape == (16, 10)
    assert np.isfinite(actions).all()
    assert np.abs(actions).max() <= 1.0
    for block in (actions[:, :3], actions[:, 5:8]):
        assert np.linalg.norm(block, axis=1).max() * TASK.action.displacement_m <= 0.009
    alone = [TASK.scripted_action(skill, o, g) for o, g in zip(obs, goal, strict=True)]
    assert actions == pytest.approx(np.array(alone), abs=1e-12)
    if skill == "handover":
        held = (obs[:, 6] > 0.2) & (obs[:, 6] < 0.4)
        held &= np.linalg.norm(obs[:, 0:3] - obs[:, 23:26], axis=1) < 0.004
        assert (actions[held, 4] < 0).all()  # what it may not open


def test_one_observation_or_many_are_the_same() -> None:
    rng = np.random.default_rng(0)
    tips = rng.normal(size=(2, 5, 4, 4))
    rings = [pose(*rng.uniform(-0.1, 0.1, 3), rpy_matrix(*rng.uniform(-1, 1, 3))) for _ in range(5)]

    class Many:
        active = "ring1"

        def pose(self, name: str) -> FloatArray:
            return np.array(rings)

    jaws = rng.uniform(0.0, 0.7, (2, 5))
    many = TASK.observe(list(tips), list(jaws), Many())  # type: ignore[arg-type]
    for i, ring in enumerate(rings):
        one = Scene(0.0, (ObjectPose("ring1", ring),), "ring1", np.zeros(3))
        assert TASK.observe(list(tips[:, i]), jaws[:, i].tolist(), one) == pytest.approx(many[i])


def test_reference_rings_hang_on_three_pegs_and_wide_ones_on_any_of_five() -> None:
    wall = TASK.cell.file.wall
    assert wall is not None
    used: dict[str, Counter[int]] = {}
    for name in TASK.distributions:
        rng, used[name] = np.random.default_rng(1), Counter()
        for _ in range(400):
            layout = TASK.sample_layout(rng, name)
            assert layout.goal[:2] == pytest.approx(GOAL_PEG)
            hung = [thing.T_task_object[1, 3] for thing in layout.objects]
            assert len(set(hung)) == 3
            y, z = layout.pose(layout.active)[1:3, 3]
            gaps = [abs(y - py) + (10.0 if pz < z else 0.0) for py, pz in wall.peg_yz_m]
            used[name][int(np.argmin(gaps))] += 1
            assert min(gaps) < 1e-9
    assert set(used["reference"]) == {0, 1, 2}
    assert set(used["wide"]) == {0, 1, 2, 3, 4}
    assert min(used["wide"].values()) > 50


def test_rings_hang_still_and_asleep_on_their_pegs_and_weigh_what_their_file_says() -> None:
    world, layout = World(TASK.cell), TASK.sample_layout(np.random.default_rng(0), "reference")
    world.reset(layout)
    ring = TASK.cell.file.ring
    assert ring is not None
    assert float(world.model.body("ring0").mass[0]) == pytest.approx(ring.mass_kg)
    for asked, found in zip(layout.objects, world.scene().objects, strict=True):
        assert found.T_task_object[:2, 3] == pytest.approx(asked.T_task_object[:2, 3], abs=1e-4)
        assert 0.0 < asked.T_task_object[2, 3] - found.T_task_object[2, 3] < 0.0015
    assert world.active_object().speed_m_s == 0.0
    assert world.data.ncon == 0  # sleeping things cost nothing
    assert world.model.neq == 2  # the jaws' couplings: nothing welds a ring to anything
    assert world.model.opt.impratio == 100.0


def test_a_ring_that_slips_off_the_board_is_not_a_ring_on_its_peg() -> None:
    world = World(TASK.cell)
    lying = rpy_matrix(0.0, math.pi / 2, 0.0)
    for place, lies in (((0.002, 0.037, 0.02), True), ((0.03, 0.037, 0.02), False)):
        world.reset(scene(*place, R=lying))
        world.run(np.repeat(world.home[None], 100, axis=0), np.zeros((100, 2, 7)))
        assert TASK.success(world.active_object(), world.scene()) is lies


def test_a_cell_without_rings_or_with_arms_in_the_wrong_mode_is_refused() -> None:
    cell = load_cell("bipegboard")
    bare = cell.file.model_copy(update={"ring": None})
    with pytest.raises(DataFileError, match="ring"):
        load_task("bipegboard", cell.__class__(cell.name, cell.arms, bare, cell.files))
    with pytest.raises(DataFileError, match="start_pitch_rad"):
        load_task("bipegboard", cell.__class__(cell.name, cell.arms[::-1], cell.file, cell.files))
