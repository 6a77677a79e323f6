"""Laws of whole plans: inside every limit, through every waypoint, along the chord, one path."""

from itertools import pairwise

import numpy as np
import pytest

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import MotionError
from viskill_deploy.core.types import Waypoint
from viskill_deploy.motion.limits import PlanLimits
from viskill_deploy.motion.plan import JointPlan, smooth
from viskill_deploy.motion.resolve import densified, resolve, task_poses
from viskill_deploy.motion.waypoints import ActionSpec, apply_action, start_waypoint

CELL = load_cell("bipegtransfer")
PERIOD_S = 0.004
PLANS = 200


def random_waypoints(seed: int, steps: int = 14) -> list[Waypoint]:
    """Smooth wandering, sharp turns, pauses, jaw commands: what policies ask for and worse."""
    rng = np.random.default_rng(seed)
    waypoint = start_waypoint(CELL, ActionSpec())
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


def test_a_roll_that_would_have_to_unwind_is_refused_with_its_waypoint() -> None:
    waypoint = start_waypoint(CELL, ActionSpec())
    waypoints = [waypoint]
    for _ in range(14):
        action = np.array([0.0, 0.0, 0.0, 1.0, 1.0] * 2)
        waypoint = apply_action(waypoint, action, waypoint.T_task_tip, CELL, ActionSpec())
        waypoints.append(waypoint)
    with pytest.raises(MotionError, match=r"roll reaches its limit at waypoint \d+"):
        resolve(CELL, waypoints, joint_start())
