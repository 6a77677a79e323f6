"""Laws of whole plans: inside every limit, through every waypoint, along the chord, one path."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.errors import MotionError
from viskill_deploy.core.types import Waypoint
from viskill_deploy.motion.limits import PlanLimits
from viskill_deploy.motion.plan import JointPlan, Part, smooth
from viskill_deploy.motion.resolve import densified, resolve, task_poses
from viskill_deploy.motion.smoothing import peaks
from viskill_deploy.motion.waypoints import ActionSpec, apply_action, start_waypoint

CELL = load_cell("bipegtransfer")
PERIOD_S = 0.004
PLANS = 200


def random_waypoints(seed: int, steps: int = 14) -> list[Waypoint]:
    """Smooth wandering, sharp turns, pauses, jaw commands: what policies ask for and worse."""
    rng = np.random.default_rng(seed)
    waypoint = start_waypoint(CELL)
    waypoints = [waypoint]
    drift, jaws = rng.uniform(-1, 1, 10), np.ones(2)
    for _ in range(steps):
        kind = rng.choice(["wander", "turn", "pause", "jaw"], p=[0.6, 0.2, 0.1, 0.1])
        action = drift + rng.normal(0, 0.2, 10) if kind == "wander" else rng.uniform(-1, 1, 10)
        if kind in {"pause", "jaw"}:
            action[:] = 0.0
        if kind == "jaw":
            jaws[rng.integers(2)] *= -1
        action[[3, 8]] *= 0.4  # or the roll runs into its limit, which has a test of its own
        action[[4, 9]] = jaws
        measured = waypoint.T_task_tip
        waypoint = apply_action(waypoint, action, measured, CELL, ActionSpec())
        waypoints.append(waypoint)
    return waypoints


def planned(seed: int, speed: float = 1.0) -> tuple[list[Waypoint], np.ndarray, JointPlan]:
    waypoints = densified(random_waypoints(seed))
    start = joint_start()
    q = resolve(CELL, waypoints, start)[1:]
    return waypoints, q, smooth(CELL, q, 0.2, speed)


def joint_start() -> list[list[float]]:
    right = [0.25, 0.0, 0.107, -0.34, -0.08, -0.24, 0.0]
    return [right, [-0.25, 0.0, 0.107, 0.34, -0.08, 0.24, 0.0]]


@pytest.mark.parametrize("block", range(10))
def test_random_plans_keep_every_limit_and_meet_every_waypoint(block: int) -> None:
    for seed in range(block * PLANS // 10, (block + 1) * PLANS // 10):
        waypoints, q, plan = planned(seed)
        table = plan.table(PERIOD_S)
        for arm in range(2):
            limits = PlanLimits.of(CELL.arms[arm].arm)
            p, v, a = table[:, arm, 0], table[:, arm, 1], table[:, arm, 2]
            assert (p >= np.array(limits.lower) - 1e-9).all()
            assert (p <= np.array(limits.upper) + 1e-9).all()
            assert (np.abs(v) <= np.array(limits.velocity) * (1 + 1e-6)).all()
            assert (np.abs(a) <= np.array(limits.acceleration) * (1 + 1e-6)).all()
            jerk = np.abs(np.diff(a, axis=0)) / PERIOD_S
            assert (jerk <= np.array(limits.jerk) * (1 + 1e-6)).all()
            steps = np.diff(task_poses(CELL, arm, p[:, :6])[:, :3, 3], axis=0)
            assert np.linalg.norm(steps, axis=1).max() / PERIOD_S <= 0.045 * 1.01
            met = np.array([plan.at(t)[arm].p for t in plan.waypoint_times])
            tips = task_poses(CELL, arm, met[:, :6])[:, :3, 3]
            wanted = np.array([w.T_task_tip[arm][:3, 3] for w in waypoints])
            assert np.abs(tips - wanted).max() <= 1e-4
            assert np.abs(met[:, 6] - q[:, arm, 6]).max() <= 1e-6


def chord_deviation(plan: JointPlan, wanted: np.ndarray, arm: int) -> float:
    worst = 0.0
    for i, (begin, end) in enumerate(pairwise(plan.waypoint_times)):
        times = np.linspace(begin, end, 12)
        q = np.array([plan.at(t)[arm].p[:6] for t in times])
        tips = task_poses(CELL, arm, q)[:, :3, 3]
        chord = wanted[i + 1] - wanted[i]
        length = np.linalg.norm(chord)
        along = np.clip((tips - wanted[i]) @ chord / max(length**2, 1e-12), 0.0, 1.0)
        worst = max(worst, np.linalg.norm(tips - wanted[i] - along[:, None] * chord, axis=1).max())
    return worst


def test_the_tip_stays_within_two_millimetres_of_the_chord() -> None:
    worst = 0.0
    for seed in range(PLANS):
        waypoints, _, plan = planned(seed)
        for arm in range(2):
            wanted = np.array([w.T_task_tip[arm][:3, 3] for w in waypoints])
            worst = max(worst, chord_deviation(plan, wanted, arm))
    assert worst <= 2e-3


def test_a_slower_plan_is_the_same_path_with_another_clock() -> None:
    for seed in range(20):
        _, _, plan = planned(seed)
        _, _, slow = planned(seed, speed=0.3)
        assert slow.duration_s > plan.duration_s
        for fast_run, slow_run in zip(plan.runs, slow.runs, strict=True):
            for share in np.linspace(0.0, 1.0, 15):
                quick = fast_run.at(share * fast_run.duration_s)
                late = slow_run.at(share * slow_run.duration_s)
                for arm in range(2):
                    q = np.array([quick[arm].p[:6], late[arm].p[:6]])
                    tips = task_poses(CELL, arm, q)[:, :3, 3]
                    assert np.linalg.norm(tips[0] - tips[1]) <= 1e-4


def cell_with_rates(factor: float) -> CellDescription:
    """The same cell with other velocity, acceleration and jerk limits, joints and jaw."""
    arms = []
    for entry in CELL.arms:
        joints = tuple(
            joint.model_copy(
                update={
                    key: getattr(joint, key) * factor
                    for key in type(joint).model_fields
                    if key.startswith("max_")
                }
            )
            for joint in entry.arm.joints
        )
        arms.append(replace(entry, arm=replace(entry.arm, joints=joints)))
    return replace(CELL, arms=tuple(arms))


@pytest.mark.parametrize("factor", [0.15, 0.5, 6.7])
def test_a_plan_that_joint_limits_stretch_is_the_same_path_re_timed(factor: float) -> None:
    other, stretched = cell_with_rates(factor), 0
    for seed in range(20):
        _, q, plan = planned(seed)
        again = smooth(other, q, 0.2)
        assert (plan.stretch < again.stretch) or factor > 1.0
        for run, twin in zip(plan.runs, again.runs, strict=True):
            stretched += abs(run.scale - twin.scale) > 0.05
            shares = np.linspace(0.0, 1.0, 30)
            for arm in range(2):
                tips = [
                    task_poses(
                        CELL, arm, np.array([r.at(x * r.duration_s)[arm].p[:6] for x in shares])
                    )[:, :3, 3]
                    for r in (run, twin)
                ]
                assert np.linalg.norm(tips[0] - tips[1], axis=1).max() <= 1e-4
    assert stretched >= 5


def test_peaks_of_a_trajectory_are_what_sampling_finds() -> None:
    _, _, plan = planned(3)
    trajectory = plan.runs[0].segments[0][0]
    t = np.linspace(0.0, trajectory.duration, 4001)
    _, v, a = (np.array(x) for x in zip(*(trajectory.at_time(x) for x in t), strict=True))
    speed, acceleration, jerk = peaks(trajectory)
    assert np.abs(v).max(axis=0) == pytest.approx(speed, rel=1e-3)
    assert np.abs(a).max(axis=0) == pytest.approx(acceleration, rel=1e-2)
    moving = speed > 0
    found = np.abs(np.diff(a, axis=0)).max(axis=0) / t[1]
    assert found[moving] == pytest.approx(jerk[moving], rel=1e-3)


def test_a_roll_that_would_have_to_unwind_is_refused_with_its_waypoint() -> None:
    waypoint = start_waypoint(CELL)
    waypoints = [waypoint]
    for _ in range(14):
        action = np.array([0.0, 0.0, 0.0, 1.0, 1.0] * 2)
        waypoint = apply_action(waypoint, action, waypoint.T_task_tip, CELL, ActionSpec())
        waypoints.append(waypoint)
    with pytest.raises(MotionError, match=r"roll reaches its limit before waypoint \d+"):
        resolve(CELL, waypoints, joint_start())


def test_a_plan_rests_where_it_is_told_to_and_its_parts_make_the_whole() -> None:
    waypoints = densified(random_waypoints(4))
    q = resolve(CELL, waypoints, joint_start())[1:]
    free = smooth(CELL, q, 0.2)
    where = next(
        i
        for i in range(4, len(q) - 4)
        if any(abs(v) > 0.01 for m in free.at(free.waypoint_times[i]) for v in m.v)
    )
    plan = smooth(CELL, q, 0.2, rests=[where])
    middle = plan.waypoint_times[where]
    for motion, axes in zip(plan.at(middle), q[where], strict=True):
        np.testing.assert_allclose(motion.p, axes, atol=1e-6)
        assert max(map(abs, motion.v)) < 1e-6
    parts = [Part(plan, 0.0, middle), Part(plan, middle, plan.duration_s - middle)]
    for time in np.linspace(0.0, plan.duration_s, 50):
        part, start = (parts[0], 0.0) if time <= middle else (parts[1], middle)
        assert [m.p for m in part.at(time - start)] == [m.p for m in plan.at(time)]
    assert parts[0].at(middle + 1.0) == parts[0].at(middle)
    assert parts[1].at(-1.0) == parts[1].at(0.0)
