"""A 7-joint arm with a straight shaft: line, gate and simulated arm keep it in its port."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.errors import KinematicsError, MotionError
from viskill_deploy.core.types import Action, Waypoint
from viskill_deploy.drivers import loopback
from viskill_deploy.kinematics.model import forward_batch, port_distances
from viskill_deploy.kinematics.straight import placed_arm
from viskill_deploy.motion.resolve import base_poses, densified
from viskill_deploy.motion.smoothing import AxisMotion
from viskill_deploy.motion.waypoints import downward_pose, start_waypoint
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.moves import axes_of
from viskill_deploy.runtime.session import Session
from viskill_deploy.runtime.trajectory import plan_waypoints
from viskill_deploy.sim.world import WorldOptions

CELL = load_cell("bodytrainer")
ARM = CELL.arms[0]
LOW = np.add(ARM.entry.workspace_lower_m, (0.005, 0.005, 0.012))
HIGH = np.array(ARM.entry.workspace_upper_m) - 0.005


class Kept:
    """A recorder that keeps what was sent and measured."""

    alive, process_id = True, 0

    def __init__(self):
        self.forget()

    def forget(self):
        self.sent, self.measured, self.tips, self.actions = [], [], [], []

    def cycle(self, now, state, request, sent, action, verdicts, mode, tip_poses):
        self.sent += [s.jp for s in sent]
        self.measured.append(state.arms[0].measured_jp)
        self.tips += request.tips
        self.actions += [(v.rule, v.action) for v in verdicts]

    def scene(self, now, scene):
        pass

    def mark(self, *args, **more):
        pass


def ready(cell: CellDescription = CELL) -> tuple[Session, Kept]:
    driver, kept = loopback.connect(cell, WorldOptions()), Kept()
    session = Session(cell, driver, Line(cell, driver.period_s), kept)
    session.make_ready()
    return session, kept


def off_port(q) -> float:
    return float(port_distances(ARM.arm, np.array(q), ARM.port_in_base).max())


def places(q) -> np.ndarray:
    T = ARM.T_task_base
    return forward_batch(ARM.arm, np.array(q))[:, :3, 3] @ T[:3, :3].T + T[:3, 3]


def off_chords(points: np.ndarray, corners: np.ndarray) -> float:
    """Largest distance of a point from the polygon through corners, m."""
    least = np.full(len(points), np.inf)
    for a, b in pairwise(corners):
        share = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        least = np.minimum(least, np.linalg.norm(points - a - share[:, None] * (b - a), axis=1))
    return float(least.max())


def waypoint(position, yaw: float, jaw: float) -> Waypoint:
    return Waypoint((downward_pose(position, yaw),), (jaw,), 0.2, "trajectory", (True,))


def follow(session: Session, way: list[Waypoint]) -> bool:
    """Whether the gate let the whole plan pass; at rest afterwards."""
    state = session.driver.state()
    plan = plan_waypoints(CELL, way, axes_of(state))
    session.begin()
    session.line.follow(plan.motion)
    while not session.line.arrived:
        session.allow(plan.waypoints[plan.index_at(session.line.phase)])
        if not session.cycle():
            session.come_to_rest()
            return False
    session.finish()
    return True


def random_paths(count: int, seed: int = 0) -> list[list[Waypoint]]:
    """Two places in the body, one after the other, each with a turn and a jaw angle."""
    dice = np.random.default_rng(seed)
    return [
        [waypoint(dice.uniform(LOW, HIGH), dice.uniform(-0.5, 0.5), dice.uniform(0, 0.5))
         for _ in range(2)]
        for _ in range(count)
    ]  # fmt: skip


def follow_all(count: int, seed: int = 0) -> tuple[float, float, float]:
    """Worst distance of the measured shaft from its port, of the measured tip from where the line
    means it to be, and of what was sent from the straight lines that were asked for, m."""
    session, kept = ready()
    worst = np.zeros(3)
    corners = [start_waypoint(CELL).T_task_tip[0][:3, 3]]
    with session:
        for way in random_paths(count, seed):
            kept.forget()
            corners = [corners[-1], *(w.T_task_tip[0][:3, 3] for w in way)]
            assert follow(session, way)
            meant = np.array(kept.tips)
            seen = places(kept.measured)
            lag = np.linalg.norm(seen[1 : len(meant)] - meant[:-1][: len(seen) - 1], axis=1).max()
            worst = np.maximum(
                worst,
                [
                    max(off_port(kept.measured), off_port(kept.sent)),
                    lag,
                    off_chords(places(kept.sent), np.array(corners)),
                ],
            )
    return float(worst[0]), float(worst[1]), float(worst[2])


def test_random_paths_in_the_body_keep_the_shaft_in_the_port_and_the_tip_on_its_way():
    port, tip, chord = follow_all(3)
    print(f"port {1e3 * port:.4f} mm, tip {1e3 * tip:.4f} mm, chord {1e3 * chord:.4f} mm")
    assert port <= 1e-4
    assert tip <= 2e-4
    assert chord <= 2e-4


@pytest.mark.slow
def test_fifty_random_paths_in_the_body():
    port, tip, chord = follow_all(50, seed=1)
    print(f"port {1e3 * port:.4f} mm, tip {1e3 * tip:.4f} mm, chord {1e3 * chord:.4f} mm")
    assert port <= 1e-4
    assert tip <= 2e-4
    assert chord <= 2e-4


def far_cell() -> CellDescription:
    """The same cell with its arm so far away that one side of the workspace is out of reach."""
    entry = ARM.entry.model_copy(
        update={"base_position_m": (-0.68, 0.0, 0.0), "port_in_base_m": (0.68, 0.0, 0.17)}
    )
    pose = ARM.T_task_base.copy()
    pose[0, 3] = -0.68
    return replace(CELL, arms=(replace(ARM, T_task_base=pose, entry=entry),))


class Outwards:
    """Leads the tip sideways at 20 mm/s, and the joints on and on where there is no reach left."""

    duration_s = 60.0
    SPEED_M_S = 0.02

    def __init__(self, cell: CellDescription, start: AxisMotion):
        arm, rows = placed_arm(cell.arms[0]), [start.p[:-1]]
        ways = 0.0005 * np.arange(400)
        for way in ways[1:]:
            pose = base_poses(cell, 0, downward_pose((-way, 0.0, 0.06), 0.0)[None])[0]
            try:
                rows.append(tuple(arm.inverse(pose, rows[-1]).tolist()))
            except KinematicsError:
                break
        self._path = CubicSpline(
            ways[: len(rows)], np.column_stack([rows, [start.p[-1]] * len(rows)])
        )
        self.last = float(ways[len(rows) - 1])

    def at(self, t: float) -> tuple[AxisMotion, ...]:
        share = min(t, 1.0)  # the speed rises within a second
        way = self.SPEED_M_S * (share**3 - share**4 / 2 + max(t - 1.0, 0.0))
        rate = self.SPEED_M_S * (3 * share**2 - 2 * share**3)
        bend = self.SPEED_M_S * (6 * share - 6 * share**2)
        s = min(way, self.last)
        slope = self._path(s, 1)
        p = self._path(s) + (way - s) * slope
        a = self._path(s, 2) * rate**2 * (way <= self.last) + slope * bend
        return (AxisMotion(*(tuple(x.tolist()) for x in (p, slope * rate, a))),)


def test_at_the_edge_of_reach_the_arm_slows_and_holds_and_never_leaves_the_port():
    cell = far_cell()
    session, kept = ready(cell)
    with session:
        session.begin()
        (start,) = session.line.setpoints
        motion = Outwards(cell, AxisMotion.at_rest((*start.jp, start.jaw)))
        session.line.follow(motion)
        while session.cycle():
            assert len(kept.sent) < 15_000
        session.come_to_rest()
    assert 0.01 < motion.last < 0.06  # the reach ends inside the workspace
    scaled = [rule for rule, action in kept.actions if action is Action.SCALE]
    assert "S15" in scaled
    assert session.cause == "S15"
    port = cell.arms[0].port_in_base
    assert port_distances(ARM.arm, np.array(kept.sent), port).max() <= 1e-4
    assert port_distances(ARM.arm, np.array(kept.measured), port).max() <= 1e-4
    assert kept.sent[-1] == kept.sent[-2]


def test_a_path_that_leaves_the_arms_reach_is_refused_before_anything_moves():
    session, _ = ready()
    with session, pytest.raises(MotionError, match="pose"):
        plan_waypoints(
            CELL, [waypoint((0.0, 0.0, -0.9), 0.0, 0.0)], axes_of(session.driver.state())
        )


def test_going_from_waypoint_to_waypoint_is_refused():
    session, _kept = ready()
    with session:
        session.begin()
        session.go_to(waypoint((0.0, 0.01, 0.06), 0.0, 0.0))
        assert not session.cycle()
        session.come_to_rest()
    assert session.cause == "S16"
    assert "needs a remote centre by mechanism" in session.line.fault


def test_a_plan_pauses_where_waypoints_repeat_and_meets_each_of_them_in_order():
    session, _ = ready()
    with session:
        held = axes_of(session.driver.state())
    here = waypoint((0.02, 0.0, 0.05), 0.0, 0.0)
    plan = plan_waypoints(CELL, [here, here, waypoint((0.02, 0.02, 0.05), 0.0, 0.0)], held)
    times = plan.motion.waypoint_times
    assert all(np.diff(times) > 0.0)
    for time, goal in zip(times, densified(list(plan.waypoints)), strict=True):
        (motion,) = plan.motion.at(time)
        assert np.linalg.norm(places([motion.p[:-1]])[0] - goal.T_task_tip[0][:3, 3]) < 1e-4
