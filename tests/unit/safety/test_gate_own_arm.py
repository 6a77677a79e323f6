"""The gate on an arm that no mechanism keeps in its port: a 7-joint arm with a straight shaft."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.core.robot_files import PrismaticJoint
from viskill_deploy.core.types import (
    Action,
    ArmState,
    CellState,
    Inputs,
    JointSetpoint,
    Request,
    Verdict,
    Waypoint,
)
from viskill_deploy.kinematics.model import forward_batch, port_distances
from viskill_deploy.kinematics.straight import placed_arm
from viskill_deploy.motion.plan import JointPlan, smooth
from viskill_deploy.motion.resolve import base_poses, densified, resolve
from viskill_deploy.motion.smoothing import AxisMotion
from viskill_deploy.motion.waypoints import downward_pose, start_waypoint
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.reach import Reach
from viskill_deploy.safety.rule_base import find_rules
from viskill_deploy.safety.rules.s15_conditioning import changes, smallest_singular_value
from viskill_deploy.safety.stopping import ArmStop, CommonStop
from viskill_deploy.safety.track import ArmTrack

PERIOD = 0.004
CELL = load_cell("bodytrainer")
ARM = CELL.arms[0]
MODEL = placed_arm(ARM)
ENVELOPE = CellEnvelope.of(CELL, PERIOD)
LIMITS = ENVELOPE.arms[0]
RULES = {rule.id: rule for rule in find_rules()}
REST = (0.0,) * 7


def joints_at(position: tuple[float, float, float], yaw: float = 0.0) -> tuple[float, ...]:
    """Joints that bring the tip there, shaft in the port."""
    start = MODEL.inverse(
        base_poses(CELL, 0, downward_pose((0.0, 0.0, 0.06), 0.0)[None])[0], ARM.seed
    )
    goal = base_poses(CELL, 0, downward_pose(position, yaw)[None])[0]
    return tuple(MODEL.inverse(goal, start).tolist())


HOME = joints_at((0.0, 0.0, 0.06))


def setpoint(q: tuple[float, ...], jaw: float = 0.3) -> JointSetpoint:
    return JointSetpoint(q, REST, jaw, 0.0)


def state_at(q: tuple[float, ...], now: float = 1.0, jaw: float = 0.3) -> CellState:
    arm = ArmState(
        "ARM1", now, True, "ENABLED", True, False, q, REST, jaw, 0.0, q, jaw,
        LIMITS.joint_names, LIMITS.tool,
    )  # fmt: skip
    return CellState((arm,), Inputs(True, now, "test", False, now))


def said(
    rule_id: str,
    before: tuple[float, ...],
    asked: tuple[float, ...],
    jaws: tuple[float, float] = (0.3, 0.3),
) -> list[Verdict]:
    """What a rule says of one step from rest."""
    rule, cycle = RULES[rule_id](ENVELOPE), Cycle(ENVELOPE)
    cycle.is_first = False
    cycle.tracks[0].begin(setpoint(before, jaws[0]))
    cycle.begin(state_at(before), Request((setpoint(asked, jaws[1]),)), 1.0)
    cycle.tracks[0].ask(setpoint(asked, jaws[1]))
    return [] if rule.margin(cycle) >= 0.0 else list(rule.judge(cycle))


@cache
def motion() -> JointPlan:
    """A plan across the workspace and back, and so many directions of motion."""
    way = [start_waypoint(CELL)]
    for place in [(0.04, 0.03, 0.03), (-0.04, 0.04, 0.05), (0.03, -0.04, 0.07)]:
        way.append(Waypoint((downward_pose(place, 0.2),), (0.0,), 0.2))
    dense = densified(way)
    q = resolve(CELL, dense[1:], [(*HOME, 0.0)])
    return smooth(CELL, q, 0.2)


def moving(count: int = 60) -> list[AxisMotion]:
    plan = motion()
    return [plan.at(t)[0] for t in np.linspace(0.05, plan.duration_s - 0.05, count)]


def stopped(kind: type[ArmStop] | type[CommonStop], m: AxisMotion) -> np.ndarray:
    """Joints along a stop, a row a period."""
    motions = list(zip(m.p, m.v, m.a, strict=True))
    stop = kind(motions, LIMITS.max_acceleration, LIMITS.max_jerk)
    count = int(np.ceil(stop.duration_s / PERIOD)) + 1
    return np.array([stop.at(i * PERIOD).jp for i in range(count + 1)])


def off_port(q: np.ndarray) -> float:
    return float(port_distances(ARM.arm, q, ARM.port_in_base).max())


@pytest.mark.invariant("S12")
def test_the_gates_own_stop_keeps_the_shaft_in_the_port_and_each_joint_for_itself_would_not():
    together = max(off_port(stopped(CommonStop, m)) for m in moving())
    apart = max(off_port(stopped(ArmStop, m)) for m in moving())
    assert together < 1e-4
    assert apart > 3e-4


@pytest.mark.invariant("S07")
def test_the_common_stop_keeps_the_jerk_limits_and_ends_at_rest():
    for m in moving(20):
        q = stopped(CommonStop, m)
        jerks = np.abs(np.diff(q, 3, axis=0)) / PERIOD**3
        assert (jerks <= np.array(LIMITS.max_jerk[:-1]) * (1 + 1e-6)).all()
        assert abs(q[-1] - q[-2]).max() < 1e-12


@pytest.mark.invariant("S03")
def test_a_common_stop_stays_inside_what_it_says_of_each_joint():
    for m in moving(20):
        stop = CommonStop(zip(m.p, m.v, m.a, strict=True), LIMITS.max_acceleration, LIMITS.max_jerk)
        q = stopped(CommonStop, m)
        assert abs(q[-1] - stop.end).max() < 1e-12
        for joint in range(7):
            low, high = stop.extent(joint)
            assert low - 1e-12 <= q[:, joint].min()
            assert q[:, joint].max() <= high + 1e-12


def test_an_arm_at_rest_stays_where_it_is_while_its_stop_lasts():
    stop = CommonStop([(0.1, 0.0, 0.0)] * 8, LIMITS.max_acceleration, LIMITS.max_jerk)
    assert stop.duration_s < 0.1
    for t in (0.0, 0.03, 1.0):
        assert stop.at(t) == JointSetpoint((0.1,) * 7, REST, 0.1, 0.0)


@pytest.mark.invariant("S14")
def test_no_point_of_the_instrument_goes_farther_in_a_stop_than_is_said():
    reach = Reach(LIMITS, PERIOD, True)
    for m in moving():
        track = ArmTrack(0, LIMITS, PERIOD)
        rows = [np.array(m.p) - t * np.array(m.v) + t * t / 2 * np.array(m.a)
                for t in (2 * PERIOD, PERIOD, 0.0)]  # fmt: skip
        track.begin(setpoint(tuple(rows[0][:-1].tolist()), float(rows[0][-1])))
        for row in rows[1:]:
            track.ask(setpoint(tuple(row[:-1].tolist()), float(row[-1])))
            track.accept()
        track.ask(track.sent)  # the stop below is from what was sent last
        track.asked_step, track.asked_bend = track.step, track.bend
        track.speed = [
            abs(s) / PERIOD / v for s, v in zip(track.step, LIMITS.max_speed, strict=True)
        ]
        track.acceleration = [
            abs(b) / PERIOD**2 / a for b, a in zip(track.bend, LIMITS.max_acceleration, strict=True)
        ]
        track.fastest = max(track.speed[:-1])
        bound = reach.travel(track)
        ends = np.array([track.q[:-1], track.asked_end()])
        tips = forward_batch(ARM.arm, ends)[:, :3, 3]
        assert np.linalg.norm(tips[1] - tips[0]) <= bound


@pytest.mark.invariant("S03")
def test_s03_holds_a_setpoint_from_which_the_common_stop_would_pass_a_limit():
    near = (*HOME[:3], LIMITS.lower[3] + 0.02, *HOME[4:])
    fast = LIMITS.max_speed[3] * PERIOD
    rule, cycle = RULES["S03"](ENVELOPE), Cycle(ENVELOPE)
    asked = (*near[:3], near[3] - fast, *near[4:])
    cycle.is_first = False
    cycle.tracks[0].begin(setpoint(near))
    cycle.begin(state_at(near), Request((setpoint(asked),)), 1.0)
    cycle.tracks[0].ask(setpoint(asked))
    assert not rule.margin(cycle) >= 0.0
    assert [(v.action, v.joint) for v in rule.judge(cycle)] == [(Action.HOLD, 3)]
    assert said("S03", HOME, HOME) == []


@pytest.mark.invariant("S12")
@pytest.mark.parametrize(
    ("off_m", "action"), [(0.0005, None), (0.0015, Action.WARN), (0.0025, Action.STOP)]
)
def test_s12_is_what_keeps_the_shaft_in_the_port(off_m, action):
    """The port is moved away sideways under an arm that stands still."""
    moved = replace(LIMITS, port=(LIMITS.port[0], LIMITS.port[1] + off_m, LIMITS.port[2]))
    cell = replace(ENVELOPE, arms=(moved,))
    rule, cycle = RULES["S12"](cell), Cycle(cell)
    cycle.tracks[0].begin(setpoint(HOME))
    cycle.begin(state_at(HOME), Request((setpoint(HOME),)), 1.0)
    verdicts = [] if rule.margin(cycle) >= 0.0 else list(rule.judge(cycle))
    assert [v.action for v in verdicts] == ([] if action is None else [action])


SHALLOW = joints_at((0.0, 0.0, 0.14))  # 30 mm past the port


@pytest.mark.invariant("S13")
def test_s13_lets_a_tip_in_the_cannula_go_deeper_and_nowhere_else():
    deeper, sideways = joints_at((0.0, 0.0, 0.1399)), joints_at((0.0001, 0.0, 0.14))
    back = joints_at((0.0, 0.0, 0.1401))
    assert said("S13", SHALLOW, SHALLOW) == []
    assert said("S13", SHALLOW, deeper) == []
    assert said("S13", SHALLOW, SHALLOW, jaws=(0.3, 0.31)) == []
    for asked in (sideways, back):
        (verdict,) = said("S13", SHALLOW, asked)
        assert (verdict.action, verdict.joint) == (Action.HOLD, -1)
        assert verdict.value == pytest.approx(0.03, abs=2e-4)
        assert verdict.limit == 0.047
    assert said("S13", HOME, joints_at((0.0005, 0.0, 0.06))) == []


@pytest.mark.invariant("S14")
@pytest.mark.parametrize(
    ("height", "action"), [(0.02, None), (0.0068, Action.SCALE), (0.0058, Action.STOP)]
)
def test_s14_slows_and_then_stops_a_shaft_on_its_way_into_the_floor(height, action):
    high, low = joints_at((0.0, 0.0, height)), joints_at((0.0, 0.0, height - 1e-6))
    assert {v.action for v in said("S14", high, low)} == ({action} - {None})
    assert said("S14", low, high) == []


@pytest.mark.invariant("S15")
def test_s15_knows_how_fast_the_smallest_singular_value_can_change():
    bounds, step = changes(LIMITS), 1e-6
    rng = np.random.default_rng(4)
    for q in rng.uniform(ARM.arm.limit(0), ARM.arm.limit(1), (40, 7)):
        ours = np.array(LIMITS.chain.jacobian((*q.tolist(), 0.3))).T
        assert abs(ours - MODEL.jacobian(q)).max() < 1e-9
        for joint, most in enumerate(bounds):
            ends = [q + side * step * np.eye(7)[joint] for side in (-1.0, 1.0)]
            low, high = (smallest_singular_value(LIMITS, tuple(end.tolist())) for end in ends)
            assert abs(high - low) / (2.0 * step) <= most + 1e-7


@pytest.mark.invariant("S15")
def test_s15_slows_and_then_holds_an_arm_that_stretches_out():
    def stretched(a4: float) -> tuple[float, ...]:
        return (0.0, 0.9, 0.0, a4, 0.0, 0.5, 0.0)

    def value(a4: float) -> float:
        return smallest_singular_value(LIMITS, stretched(a4))

    angles = np.linspace(-1.2, 0.0, 600)
    slow = next(float(a) for a in angles if value(a) < 0.095)
    near = next(float(a) for a in angles if value(a) < 0.065)
    for a4, action in ((slow, Action.SCALE), (near, Action.HOLD)):
        on, back = stretched(a4 + 1e-4), stretched(a4 - 1e-4)
        assert [v.action for v in said("S15", stretched(a4), on)] == [action]
        assert said("S15", stretched(a4), back) == []


@pytest.mark.invariant("S30")
def test_s30_names_the_jaw_by_the_index_behind_the_last_joint():
    (verdict,) = said("S30", HOME, HOME, jaws=(0.0, 0.021))
    assert (verdict.joint, verdict.action) == (7, Action.HOLD)


def changed(**updates: object) -> CellDescription:
    return replace(CELL, arms=(replace(ARM, arm=replace(ARM.arm, **updates)),))


def slider(a=0.0, d=0.0, offset=0.0, lower=-0.06, upper=0.04) -> PrismaticJoint:
    return PrismaticJoint(
        name="rail", type="prismatic", alpha_rad=0.0, a_m=a, theta_rad=0.0, d_m=d, offset_m=offset,
        lower_m=lower, upper_m=upper, max_velocity_m_s=0.1, max_acceleration_m_s2=0.5,
        max_jerk_m_s3=10.0,
    )  # fmt: skip


def with_joint(**updates: object) -> CellDescription:
    joints = (
        *ARM.arm.joints[:3],
        ARM.arm.joints[3].model_copy(update=updates),
        *ARM.arm.joints[4:],
    )
    return changed(joints=joints)


def with_gate(**updates: object) -> CellDescription:
    return changed(gate=ARM.arm.gate.model_copy(update=updates))


def with_instrument(**updates: object) -> CellDescription:
    return changed(instrument=ARM.arm.instrument.model_copy(update=updates))


def with_jaw(**updates: object) -> CellDescription:
    return changed(jaw=ARM.arm.jaw.model_copy(update=updates))


@pytest.mark.parametrize(
    ("cell", "key"),
    [
        (with_joint(max_velocity_rad_s=1.6), "a4.max_velocity"),
        (with_joint(max_acceleration_rad_s2=8.0), "a4.max_acceleration"),
        (with_joint(max_jerk_rad_s3=160.0), "a4.max_jerk"),
        (with_joint(lower_rad=-6.3), "a4.lower"),
        (with_joint(upper_rad=float("nan")), "a4.upper"),
        (with_joint(lower_rad=0.0, upper_rad=0.02), "range less margins"),
        (with_gate(tracking_rad=0.007), "gate.tracking"),
        (with_gate(first_command_rad=0.002), "gate.first_command"),
        (with_gate(port_stop_m=0.003), "gate.port_stop_m"),
        (with_instrument(shaft_length_m=0.8), "instrument.shaft_length_m"),
        (with_instrument(tip_position_m=(0.0, 0.0, 0.8)), "instrument.tip_position_m"),
        (with_jaw(upper_rad=1.5), "jaw.upper"),
        (with_jaw(max_velocity_rad_s=7.0), "jaw.max_velocity"),
    ],
)
def test_looser_numbers_than_the_ceilings_of_an_own_arm_are_refused(cell, key):
    with pytest.raises(DataFileError, match=key):
        CellEnvelope.of(cell, PERIOD)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("lower_m", -1.01, "rail.lower"),
        ("upper_m", 1.01, "rail.upper"),
        ("upper_m", -0.0585, "rail range less margins"),
        ("max_velocity_m_s", 0.21, "rail.max_velocity"),
        ("max_acceleration_m_s2", 1.01, "rail.max_acceleration"),
        ("max_jerk_m_s3", 20.1, "rail.max_jerk"),
    ],
)
@pytest.mark.invariant("S31")
def test_no_limit_of_a_joint_that_slides_gets_looser(key, value, said):
    joints = (ARM.arm.joints[0], slider().model_copy(update={key: value}), *ARM.arm.joints[1:])
    with pytest.raises(DataFileError) as error:
        CellEnvelope.of(changed(joints=joints), PERIOD)
    assert error.value.key == said


def test_a_port_far_from_the_base_is_this_arms_own_and_no_farther_than_it_reaches():
    assert LIMITS.port == pytest.approx((0.0, 0.0, 0.17))
    entry = ARM.entry.model_copy(update={"port_in_base_m": (2.1, 0.0, 0.17)})
    with pytest.raises(DataFileError, match="port_in_base_m"):
        CellEnvelope.of(replace(CELL, arms=(replace(ARM, entry=entry),)), PERIOD)


@pytest.mark.parametrize(
    ("a", "d", "offset", "lower", "upper", "far"),
    [
        (0.0, 0.1, 0.05, -0.3, 0.4, 0.1 + 0.05 + 0.4),
        (-0.02, -0.1, -0.05, -0.06, 0.04, 0.02 + 0.1 + 0.05 + 0.06),
    ],
)
def test_a_joint_that_slides_has_limits_and_levers_of_its_own(a, d, offset, lower, upper, far):
    rail = slider(a, d, offset, lower, upper)
    arm = CellEnvelope.of(changed(joints=(ARM.arm.joints[0], rail, *ARM.arm.joints[1:])), PERIOD)
    (limits,) = arm.arms
    assert limits.slides == (False, True, *(False,) * 6)
    assert limits.levers[1] == 1.0
    # the rail's sides, its zero's offset and its travel, all behind the first joint
    assert limits.levers[0] == pytest.approx(LIMITS.levers[0] + far)
    assert (limits.margin[1], limits.tracking[1]) == (0.001, 0.003)
