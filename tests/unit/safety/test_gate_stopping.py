import math

import numpy as np
import pytest
import ruckig
from gate_rig import Rig
from hypothesis import given
from hypothesis import strategies as st

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.types import JointSetpoint
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.stopping import ArmStop, JointStop, braking
from viskill_deploy.safety.track import ArmTrack

LIMITS = [(7.85, 157.0, 1.57), (1.0, 20.0, 0.2), (63.0, 1260.0, 18.8)]


def ruckig_stop(p: float, v: float, a: float, a_max: float, j_max: float):
    """Ruckig's fastest way to zero speed and acceleration."""
    otg = ruckig.Ruckig(1)
    given_ = ruckig.InputParameter(1)
    given_.control_interface = ruckig.ControlInterface.Velocity
    given_.current_position, given_.current_velocity = [p], [v]
    given_.current_acceleration = [a]
    given_.target_velocity, given_.target_acceleration = [0.0], [0.0]
    given_.max_acceleration, given_.max_jerk = [a_max], [j_max]
    trajectory = ruckig.Trajectory(1)
    assert otg.calculate(given_, trajectory) == ruckig.Result.Working
    return trajectory


@pytest.mark.parametrize(("a_max", "j_max", "v_max"), LIMITS)
def test_the_stop_is_ruckigs_stop(a_max, j_max, v_max):
    rng = np.random.default_rng(0)
    for v, a in zip(rng.uniform(-v_max, v_max, 500), rng.uniform(-a_max, a_max, 500), strict=True):
        ours = JointStop(0.3, v, a, a_max, j_max)
        theirs = ruckig_stop(0.3, v, a, a_max, j_max)
        assert ours.duration_s == pytest.approx(theirs.duration, abs=1e-9)
        for t in np.linspace(0.0, ours.duration_s, 9):
            p, speed, acceleration = theirs.at_time(t)[:3]
            assert ours.at(t) == pytest.approx((p[0], speed[0], acceleration[0]), abs=1e-7)


def motions(factor: float):
    return st.tuples(
        st.sampled_from(LIMITS),
        st.floats(-factor, factor, allow_subnormal=False),
        st.floats(-factor, factor, allow_subnormal=False),
    )


@pytest.mark.invariant("S34")
@given(motions(1.2))
def test_any_motion_comes_to_rest_inside_the_limits(case):
    (a_max, j_max, v_max), v_part, a_part = case
    v, a = v_part * v_max, a_part * a_max
    stop = JointStop(0.0, v, a, a_max, j_max)
    fastest = abs(v) + a * a / (2.0 * j_max)
    times = np.linspace(0.0, stop.duration_s, 200)
    path = np.array([stop.at(t) for t in times])
    assert (abs(path[:, 1]) <= fastest * (1 + 1e-9) + 1e-12).all()
    assert (abs(path[:, 2]) <= max(a_max, abs(a)) * (1 + 1e-9)).all()
    jerks = {abs(phase[4]) for phase in stop.phases}
    assert jerks <= {0.0, j_max}
    assert stop.at(stop.duration_s)[1:] == (0.0, 0.0)
    just_before = stop.at(math.nextafter(stop.duration_s, 0.0))
    assert just_before[0] == pytest.approx(stop.end, abs=1e-9)
    assert just_before[1:] == pytest.approx((0.0, 0.0), abs=1e-6)


@given(motions(1.2))
def test_the_extent_holds_the_whole_way_and_the_bound_holds_the_extent(case):
    (a_max, j_max, v_max), v_part, a_part = case
    v, a = v_part * v_max, a_part * a_max
    stop = JointStop(0.5, v, a, a_max, j_max)
    first, last = stop.extent()
    path = [stop.at(t)[0] for t in np.linspace(0.0, stop.duration_s, 300)]
    assert first - 1e-12 <= min(path)
    assert max(path) <= last + 1e-12
    # Not wider than what was walked, but for the coarse sampling of this test.
    assert min(path) - first <= 0.02 * (last - first) + 1e-12
    assert last - max(path) <= 0.02 * (last - first) + 1e-12
    w = abs(v) + a * a / (2.0 * j_max)
    bound = w * (abs(a) / j_max + w / (2.0 * a_max) + a_max / (2.0 * j_max))
    assert last - first <= bound * (1 + 1e-9) + 1e-12


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("part", [0.1, 0.5, 0.6, 0.9, 0.99])
def test_the_extent_holds_the_turn_of_a_motion_that_has_to_reverse(side, part):
    """Speed so small against acceleration that taking the acceleration back reverses it."""
    a_max, j_max = 7.85, 157.0
    v, a = -side * part * a_max**2 / (2.0 * j_max), side * a_max
    stop = JointStop(0.0, v, a, a_max, j_max)
    path = [stop.at(t)[0] for t in np.linspace(0.0, stop.duration_s, 2000)]
    assert min(path) < 0.0 < max(path) or part > 0.5
    assert stop.extent() == pytest.approx((min(path), max(path)), abs=1e-8)


def test_speed_is_carried_from_the_middle_of_a_period_to_its_end():
    rig = Rig.running()
    track = ArmTrack(0, rig.gate.envelope.arms[0], rig.period)
    old, a = rig.held[0], 0.8
    track.begin(old)
    for k in range(1, 4):
        depth = old.jp[2] + 0.5 * a * (k * rig.period) ** 2
        jp = (*old.jp[:2], depth, *old.jp[3:])
        track.ask(JointSetpoint(jp, (0.0,) * 6, old.jaw, 0.0))
        if k < 3:
            track.accept()
    assert track.asked_motion(2) == pytest.approx((depth, a * 3 * rig.period, a), rel=1e-6)


def test_rest_needs_no_stop():
    assert braking(0.0, 0.0, 1.0, 20.0) == []
    stop = JointStop(0.1, 0.0, 0.0, 1.0, 20.0)
    assert stop.duration_s == 0.0
    assert stop.at(0.0) == (0.1, 0.0, 0.0)
    assert stop.extent() == (0.1, 0.1)


def test_acceleration_that_ends_at_zero_speed_is_only_taken_back():
    v, a, j = -1.0 / 40.0, 1.0, 20.0
    assert braking(v, a, 1.0, j) == [(0.05, -20.0)]
    assert braking(-v, -a, 1.0, j) == [(0.05, 20.0)]


def test_braking_harder_than_allowed_is_eased_first():
    first = braking(1.0, -9.0, 7.85, 157.0)[0]
    assert first == pytest.approx(((9.0 - 7.85) / 157.0, 157.0))


def tip_stop(envelope, q, dq, ddq) -> tuple[float, float]:
    """Duration of the gate's stop and way of the control point in it."""
    arm = envelope.arms[0]
    motion = [(p, v, a) for p, v, a in zip((*q, 0.0), (*dq, 0.0), (*ddq, 0.0), strict=True)]
    stop = ArmStop(motion, arm.max_acceleration, arm.max_jerk)
    start = np.array(arm.chain.points(tuple(q))[0])
    ways = [
        np.linalg.norm(np.array(arm.chain.points(stop.at(t).jp)[0]) - start)
        for t in np.linspace(0.0, stop.duration_s, 9)
    ]
    return stop.duration_s, max(ways)


def tip_jacobian(chain, q) -> np.ndarray:
    here = np.array(chain.points(tuple(q))[0])
    columns = []
    for joint in range(6):
        nudged = np.array(q)
        nudged[joint] += 1e-7
        columns.append((np.array(chain.points(tuple(nudged))[0]) - here) / 1e-7)
    return np.array(columns).T


@pytest.mark.invariant("S34")
@pytest.mark.parametrize(
    ("pitch", "accelerating", "longest_s", "farthest_m"),
    [
        (0.6, 0, 0.2, 0.005),
        (0.6, 1, 0.3, 0.010),
        # Beyond 35 degrees of pitch the yaw lever is short: 50 mm/s asks for more of the joint.
        (0.925, 0, 0.23, 0.006),
        (0.925, 3, 0.31, 0.011),
    ],
)
def test_from_50_mm_per_s_at_any_depth_the_stop_is_short(
    pitch, accelerating, longest_s, farthest_m
):
    """Any way of the tip, wrist still or not; the first joints speed up at their limit."""
    envelope = CellEnvelope.of(load_cell("bipegtransfer"), 0.004)
    arm, rng = envelope.arms[0], np.random.default_rng(5)
    worst_s = worst_m = 0.0
    for _ in range(600):
        q = rng.uniform(arm.lower[:6], arm.upper[:6])
        q[1] = rng.uniform(-pitch, pitch)
        q[2] = rng.uniform(arm.insertion_min, arm.upper[2])
        way = rng.normal(size=3)
        moving = [0, 1, 2] if rng.random() < 0.5 else [0, 1, 2, 4, 5]
        J = tip_jacobian(arm.chain, q)[:, moving]
        dq, ddq = np.zeros(6), np.zeros(6)
        dq[moving] = np.linalg.pinv(J) @ (0.05 * way / np.linalg.norm(way))
        if (abs(dq) > arm.max_speed[:6]).any():
            continue
        hardest = np.argsort(-abs(dq[:3]) / arm.max_speed[:3])[:accelerating]
        ddq[hardest] = np.sign(dq[hardest]) * np.array(arm.max_acceleration)[hardest]
        duration, far = tip_stop(envelope, q, dq, ddq)
        worst_s, worst_m = max(worst_s, duration), max(worst_m, far)
    assert worst_s <= longest_s
    assert worst_m <= farthest_m


def test_a_sampled_stop_keeps_the_limits_by_differences_too():
    rig = Rig.running()
    rig.swing(30)
    arm = rig.gate.envelope.arms[0]
    track = ArmTrack(0, arm, rig.period)
    track.begin(rig.held[0])
    sent = [rig.held[0].jp[2]]
    rig.estop = True
    decisions = rig.rest()
    sent += [d.setpoints[0].setpoint.jp[2] for d in decisions]
    steps = np.diff(sent) / rig.period
    bends = np.diff(steps) / rig.period
    assert (abs(bends) <= arm.max_acceleration[2] * (1 + 1e-9)).all()
    assert (abs(steps) <= 0.0401).all()
    assert decisions[-1].setpoints[0].setpoint.jv == (0.0,) * 6
