"""Segments: the closed loop's motion from the present state to the next waypoint."""

import numpy as np
import pytest

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import MotionError
from viskill_deploy.kinematics.closed_form import inverse_batch
from viskill_deploy.motion.limits import PlanLimits
from viskill_deploy.motion.resolve import base_poses, task_poses
from viskill_deploy.motion.smoothing import AxisMotion, Segment, SegmentPlanner
from viskill_deploy.motion.waypoints import ActionSpec, apply_action, start_waypoint

CELL = load_cell("bipegtransfer")
PERIOD_S, STEP_S = 0.004, 0.2
START = (
    [0.25, 0.0, 0.107, -0.34, -0.08, -0.24, -0.3],
    [-0.25, 0.0, 0.107, 0.34, -0.08, 0.24, -0.3],
)


def follow(seed: int, steps: int) -> list[tuple[tuple[AxisMotion, ...], Segment]]:
    """Segments of a random policy that changes its mind at every step."""
    rng = np.random.default_rng(seed)
    planner = SegmentPlanner(CELL, PERIOD_S)
    waypoint = start_waypoint(CELL)
    state = tuple(AxisMotion.at_rest(q) for q in START)
    result = []
    for _ in range(steps):
        action = rng.uniform(-1, 1, 10)
        action[[3, 8]] *= 0.3
        waypoint = apply_action(waypoint, action, waypoint.T_task_tip, CELL, ActionSpec())
        target = []
        for arm in range(2):
            pose = base_poses(CELL, arm, waypoint.T_task_tip[arm][None])
            q, reached = inverse_batch(CELL.arms[arm].arm, pose, np.array([state[arm].p[:6]]))
            assert reached.all()
            target.append((*q[0], waypoint.jaw[arm]))
        end = [
            [(g - p) / STEP_S for g, p in zip(goal[:6], s.p[:6], strict=True)] + [0.0]
            for goal, s in zip(target, state, strict=True)
        ]
        segment = planner.plan(state, target, end, STEP_S)
        result.append((state, segment))
        state = segment.at(segment.duration_s)
        for arm in range(2):
            np.testing.assert_allclose(
                state[arm].p, target[arm], atol=1e-7
            )  # Ruckig's own accuracy
    return result


@pytest.mark.parametrize("seed", range(8))
def test_segments_of_a_restless_policy_keep_every_limit_and_the_tip_speed(seed: int) -> None:
    chain = follow(seed, 40)
    tables = [
        np.vstack([np.array([[m.p for m in start]]), seg.table(PERIOD_S)[0]])
        for start, seg in chain
    ]
    for arm in range(2):
        limits = PlanLimits.of(CELL.arms[arm].arm)
        for table in tables:
            steps = np.diff(table[:, arm], axis=0) / PERIOD_S
            assert (np.abs(steps) <= np.array(limits.velocity) * (1 + 1e-6)).all()
            tips = np.diff(task_poses(CELL, arm, table[:, arm, :6])[:, :3, 3], axis=0)
            assert np.linalg.norm(tips, axis=1).max() / PERIOD_S <= 0.0475
        whole = np.vstack([tables[0][:, arm], *(t[1:, arm] for t in tables[1:])])
        acceleration = np.diff(whole, n=2, axis=0) / PERIOD_S**2
        assert (np.abs(acceleration) <= np.array(limits.acceleration) * (1 + 1e-6)).all()
        jerk = np.diff(whole, n=3, axis=0) / PERIOD_S**3
        assert (np.abs(jerk) <= np.array(limits.jerk) * (1 + 1e-5)).all()


def test_a_segment_lasts_whole_control_periods_and_reports_its_stretch() -> None:
    for _, segment in follow(3, 10):
        periods = segment.duration_s / PERIOD_S
        assert periods == pytest.approx(round(periods))
        assert segment.stretch == pytest.approx(segment.duration_s / STEP_S)
        assert segment.stretch >= 1.0 - 1e-9


def test_a_target_outside_the_joint_limits_is_refused() -> None:
    planner = SegmentPlanner(CELL, PERIOD_S)
    start = tuple(AxisMotion.at_rest(q) for q in START)
    beyond = [[*START[0][:2], 0.25, *START[0][3:]], START[1]]
    with pytest.raises(MotionError, match="joint limit"):
        planner.plan(start, beyond, [[0.0] * 7] * 2, 4.0)


@pytest.mark.parametrize(("speed", "period"), [(0.0, 0.004), (1.1, 0.004), (1.0, 0.0)])
def test_a_planner_without_sense_is_refused(speed: float, period: float) -> None:
    with pytest.raises(MotionError):
        SegmentPlanner(CELL, period, speed)


def test_a_target_that_is_not_finite_is_refused() -> None:
    planner = SegmentPlanner(CELL, PERIOD_S)
    start = tuple(AxisMotion.at_rest(q) for q in START)
    target = [[float("nan"), *START[0][1:]], START[1]]
    with pytest.raises(MotionError, match="no jerk-limited motion"):
        planner.plan(start, target, [[0.0] * 7] * 2, STEP_S)
