"""The line: what it asks the gate for between two waypoints, and how it follows the time base."""

from dataclasses import replace

import numpy as np
import pytest

from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.errors import MotionError
from viskill_deploy.core.types import Waypoint
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.kinematics.arm import Arm
from viskill_deploy.motion.resolve import task_poses, waypoint_at
from viskill_deploy.motion.waypoints import ActionSpec, apply_action
from viskill_deploy.runtime.line import SLOWEST, Line

CELL = load_cell("bipegtransfer")
PERIOD_S = 0.004


def started(
    cell: CellDescription = CELL, solver: str = "daqp", speed: float = 1.0
) -> tuple[Line, Waypoint]:
    driver = LoopbackDriver(cell)
    driver.connect()
    line = Line(cell, PERIOD_S, solver, speed)
    line.start(driver.state())
    return line, waypoint_at(cell, driver.world.home)


def moved(waypoint: Waypoint, *action: float) -> Waypoint:
    both = np.array([*action, 1.0] * 2)
    return apply_action(waypoint, both, waypoint.T_task_tip, CELL, ActionSpec())


def walk(line: Line) -> np.ndarray:
    rows = []
    while not line.arrived:
        request = line.request(0.0)
        assert request.setpoints is not None, request.failure
        rows.append([s.jp for s in request.setpoints])
        line.advance(1.0)
    return np.array(rows)


@pytest.mark.parametrize("solver", ["daqp", "osqp"])
def test_the_qp_of_every_tick_returns_the_segment_while_no_limit_is_active(solver: str) -> None:
    line, waypoint = started(solver=solver)
    for action in [(0.5, -0.5, -0.5, 0.3), (0.9, 0.1, 0.2, -0.3), (-0.2, -0.9, 0.0, 0.0)]:
        waypoint = moved(waypoint, *action)
        line.go_to(waypoint)
        while not line.arrived:
            wish = line.sample()
            request = line.request(0.0)
            assert request.setpoints is not None
            for setpoint, motion in zip(request.setpoints, wish, strict=True):
                np.testing.assert_allclose(setpoint.jp, motion.p[:6], atol=1e-5)
                np.testing.assert_allclose(setpoint.jv, motion.v[:6], atol=5e-3)
            line.advance(1.0)


def test_every_waypoint_is_met_within_a_tenth_of_a_millimetre() -> None:
    line, waypoint = started()
    rng = np.random.default_rng(1)
    for _ in range(20):
        waypoint = moved(waypoint, *rng.uniform(-1, 1, 3), 0.2 * rng.uniform(-1, 1))
        line.go_to(waypoint)
        last = walk(line)[-1]
        for arm in range(2):
            tip = task_poses(CELL, arm, last[arm][None])[0]
            assert np.abs(tip - waypoint.T_task_tip[arm]).max() < 1e-4


def test_every_request_says_where_the_tips_are_meant_to_be() -> None:
    line, waypoint = started()
    line.go_to(moved(waypoint, 0.4, -0.6, -0.3, 0.3))
    while not line.arrived:
        request = line.request(0.0)
        assert request.setpoints is not None
        for arm, (setpoint, tip) in enumerate(zip(request.setpoints, request.tips, strict=True)):
            pose = task_poses(CELL, arm, np.array(setpoint.jp)[None])[0]
            np.testing.assert_allclose(tip, pose[:3, 3], atol=1e-6)
        line.advance(1.0)


def test_the_last_waypoint_is_met_at_rest() -> None:
    line, waypoint = started()
    line.go_to(moved(waypoint, 0.5, 0.5, -0.5, 0.0), last=True)
    walk(line)
    request = line.request(0.0)
    assert request.setpoints is not None
    assert max(abs(v) for s in request.setpoints for v in s.jv) < 1e-6
    assert request.waypoint_due_s == np.inf


def test_a_waypoint_out_of_reach_leaves_the_gate_without_setpoints() -> None:
    line, waypoint = started()
    far = [pose.copy() for pose in waypoint.T_task_tip]
    far[0][2, 3] = -0.3
    assert line.go_to(replace(waypoint, T_task_tip=tuple(far))) == 1.0
    request = line.request(0.0)
    assert request.setpoints is None
    assert request.failure
    assert not line.arrived


def test_the_time_base_slows_the_same_path_and_recovers() -> None:
    fast, waypoint = started()
    goal = moved(waypoint, 0.6, -0.6, -0.2, 0.3)
    fast.go_to(goal)
    path = walk(fast)
    slow, _ = started()
    slow.go_to(goal)
    for _ in range(20):
        assert slow.request(0.0).setpoints is not None
        slow.advance(0.5)
    slowest = slow.rate
    assert slowest == pytest.approx(1.0 - 2.5 * PERIOD_S**2 * 20 * 21)
    rows = walk(slow)
    assert slow.rate > slowest
    past = 0.45 * PERIOD_S  # at most a period past the end, at the speed of the end
    np.testing.assert_allclose(rows[-1], path[-1], atol=past)
    accelerations = np.abs(np.diff(rows, n=2, axis=0)).max(axis=(0, 1)) / PERIOD_S**2
    assert (accelerations <= np.array(CELL.arms[0].arm.limit(3))).all()


def test_a_slower_time_base_goes_on_smoothly_from_segment_to_segment() -> None:
    """Slowed and let go again at any moment: no jump in speed, acceleration within a fifth of
    the gate's limits, jerk too, also where one segment follows another."""
    line, waypoint = started()
    rng, rows, rates = np.random.default_rng(3), [], []
    scale = 1.0
    for step in range(12):
        waypoint = moved(waypoint, *rng.uniform(-1, 1, 3), 0.3 * rng.uniform(-1, 1))
        line.go_to(waypoint, last=step == 11)
        while not line.arrived:
            request = line.request(0.0)
            assert request.setpoints is not None, request.failure
            rows.append([(*s.jp, s.jaw) for s in request.setpoints])
            scale = float(rng.choice([0.85, 1.0])) if len(rows) % 30 == 0 else scale
            line.advance(scale)
            rates.append(line.rate)
    arm = CELL.arms[0].arm
    limits = [(*arm.limit(3), arm.jaw.max_acceleration_rad_s2)]
    limits.append((*arm.limit(4), arm.jaw.max_jerk_rad_s3))
    assert SLOWEST <= min(rates) < 0.6
    for order, limit in enumerate(limits, start=2):
        peaks = np.abs(np.diff(rows, n=order, axis=0)).max(axis=(0, 1)) / PERIOD_S**order
        assert (peaks <= 1.2 * np.array(limit)).all(), order
    changes = np.diff([1.0, *rates]) / PERIOD_S
    assert np.abs(changes).max() <= 1.0 + 1e-9
    assert np.abs(np.diff([0.0, *changes])).max() <= 5.0 * PERIOD_S + 1e-9


def test_a_time_base_that_comes_to_its_slowest_stays_there() -> None:
    line, waypoint = started()
    line.go_to(moved(waypoint, 0.2, 0.2, -0.2, 0.0))
    for _ in range(2000):
        line.advance(0.1)
    assert line.rate == pytest.approx(SLOWEST, abs=1e-6)


def test_the_time_at_which_the_next_waypoint_is_due_is_the_end_of_the_segment() -> None:
    line, waypoint = started()
    line.go_to(moved(waypoint, 0.9, 0.0, 0.0, 0.0))
    assert line.motion is not None
    assert line.request(10.0).waypoint_due_s == pytest.approx(10.0 + line.motion.duration_s)


def test_a_displaced_port_goes_into_the_qp_and_shows_as_remote_centre_error() -> None:
    arm = CELL.arms[0]
    entry = arm.entry.model_copy(update={"port_in_base_m": (0.002, 0.0, 0.0)})
    cell = replace(CELL, arms=(replace(arm, entry=entry), CELL.arms[1]))
    line, waypoint = started(cell)
    line.go_to(moved(waypoint, 0.2, 0.2, -0.5, 0.0))
    rows = walk(line)
    kinematics = Arm(arm.arm)
    tilt = [kinematics.rcm_error(q, (0.002, 0.0, 0.0)) for q in rows[:, 0]]
    assert max(tilt) <= 0.002 + 1e-9
    assert min(tilt) > 0.0015


def test_a_line_at_a_part_of_full_speed_goes_the_same_way_at_that_part_of_every_speed() -> None:
    full, waypoint = started()
    goal = moved(waypoint, 0.6, -0.6, -0.2, 0.3)
    full.go_to(goal, last=True)
    path = np.array(walk(full))
    quarter, _ = started(speed=0.25)
    quarter.go_to(goal, last=True)
    slow = np.array(walk(quarter))
    np.testing.assert_allclose(slow[3::4][: len(path)], path, atol=2e-5)
    fastest = np.abs(np.diff(path, axis=0)).max()
    assert np.abs(np.diff(slow, axis=0)).max() == pytest.approx(fastest / 4, rel=0.05)


@pytest.mark.parametrize("speed", [0.0, -0.5, 1.01, float("nan")])
def test_a_line_has_no_other_speed_than_a_part_of_full_speed(speed: float) -> None:
    with pytest.raises(MotionError, match="ask for a part of full speed"):
        Line(CELL, PERIOD_S, speed=speed)
