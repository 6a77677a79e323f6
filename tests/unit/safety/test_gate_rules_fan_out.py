"""Every rule at every level, joint by joint and arm by arm."""

import math
from dataclasses import fields, replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from gate_rig import PERIOD, RULES, Rig, asking, words, worst

from viskill_deploy.core.types import Action, JointSetpoint, Request
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.rule_base import Needs, find_rules, verdicts_of
from viskill_deploy.safety.rules import (
    s05_joint_speed,
    s15_conditioning,
    s18_feedback_age,
    s24_driver,
)

ARMS, JOINTS, AXES, SIGNS = range(2), range(6), range(7), (-1.0, 1.0)
BAD_NUMBERS = [math.nan, math.inf, -math.inf, 1e309]
WRONG_TYPES = [1, True, None, "0.1", np.float32(0.1), 0.1 + 0j]
FINE_NUMBERS = [-0.0, 5e-324, np.float64(0.1)]
FACTORS = [
    (0.5, Action.PASS),
    (0.999999, Action.PASS),
    (1.0, Action.PASS),
    (1.000001, Action.SCALE),
    (1.2, Action.SCALE),
    (1.200001, Action.HOLD),
    (3.0, Action.HOLD),
]


def made(rule_id: str):
    return RULES[rule_id](Rig().gate.envelope)


def cycle_of(rig: Rig, request: Request | None = None, now: float | None = None) -> Cycle:
    cycle = Cycle(rig.gate.envelope)
    for track, setpoint in zip(cycle.tracks, rig.stay(), strict=True):
        track.begin(setpoint)
    cycle.begin(rig.state(), request or Request(rig.stay()), rig.now if now is None else now)
    return cycle


def replaced(vector: tuple, index: int, value) -> tuple:
    return tuple(value if i == index else x for i, x in enumerate(vector))


def test_every_rule_has_its_own_id_and_says_what_it_needs():
    rules = find_rules()
    assert len({rule.id for rule in rules}) == len(rules)
    assert all(isinstance(rule.needs, Needs) for rule in rules)


def test_s01_takes_a_list_for_no_setpoints_and_blames_no_arm():
    rig = Rig()
    nothing_wrong, unsound = rig.stay()[0], replace(rig.stay()[1], jaw=math.nan)
    for setpoints in ([nothing_wrong, unsound], [nothing_wrong] * 2, (), (nothing_wrong,) * 3):
        (verdict,) = words(made("S01"), cycle_of(rig, Request(setpoints)))
        assert (verdict.action, verdict.arm, verdict.joint) == (Action.FAULT, -1, -1)


@pytest.mark.parametrize("rule_id", ["S01", "S02"])
def test_what_cannot_be_used_has_a_margin_of_minus_one(rule_id):
    rig = Rig()
    rig.broken[0] = {"jaw_measured_jp": math.nan}
    setpoints = replaced(rig.stay(), 0, replace(rig.stay()[0], jaw=math.nan))
    cycle = cycle_of(rig, Request(setpoints))
    assert made(rule_id).margin(cycle) == -1.0
    assert made(rule_id).margin(cycle_of(Rig())) == 1.0


def test_s02_takes_what_looks_like_an_arms_state_for_none():
    rig = Rig()
    cycle = cycle_of(rig)
    first, *others = rig.state().arms
    double = SimpleNamespace(**{field.name: getattr(first, field.name) for field in fields(first)})
    cycle.state = replace(cycle.state, arms=(double, *others))
    (verdict,) = words(made("S02"), cycle)
    assert (verdict.action, verdict.arm) == (Action.FAULT, 0)


# S01, S02: numbers ---------------------------------------------------------------------------


def setpoints_with(rig: Rig, arm: int, field: str, index: int, value) -> tuple:
    old = rig.stay()[arm]
    changed = (
        replace(old, **{field: value})
        if field in ("jaw", "jaw_v")
        else replace(old, **{field: replaced(getattr(old, field), index, value)})
    )
    return replaced(rig.stay(), arm, changed)


FIELDS = [*(("jp", i) for i in JOINTS), *(("jv", i) for i in JOINTS), ("jaw", 6), ("jaw_v", 6)]


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize(("field", "index"), FIELDS)
@pytest.mark.parametrize("value", BAD_NUMBERS + WRONG_TYPES)
def test_s01_faults_on_any_number_that_is_not_a_finite_float(arm, field, index, value):
    rig = Rig()
    cycle = cycle_of(rig, Request(setpoints_with(rig, arm, field, index, value)))
    (verdict,) = words(made("S01"), cycle)
    assert (verdict.action, verdict.arm, verdict.joint) == (Action.FAULT, arm, index)


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize(("field", "index"), FIELDS)
@pytest.mark.parametrize("value", FINE_NUMBERS)
def test_s01_passes_finite_floats(arm, field, index, value):
    rig = Rig()
    assert (
        words(made("S01"), cycle_of(rig, Request(setpoints_with(rig, arm, field, index, value))))
        == []
    )


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("field", ["jp", "jv"])
@pytest.mark.parametrize(
    "value", [(), (0.0,) * 5, (0.0,) * 7, [0.0] * 6, np.zeros(6), None, 0.0, "000000"]
)
def test_s01_faults_on_a_wrong_shape(arm, field, value):
    rig = Rig()
    changed = replace(rig.stay()[arm], **{field: value})
    (verdict,) = words(made("S01"), cycle_of(rig, Request(replaced(rig.stay(), arm, changed))))
    assert (verdict.action, verdict.arm, verdict.joint) == (Action.FAULT, arm, -1)


def test_s01_faults_on_wrong_numbers_of_arms_and_foreign_things():
    rig, rule = Rig(), made("S01")
    one, two = rig.stay()
    for setpoints in [(), (one,), (one, two, one), [one, two], "ab"]:
        assert worst(words(rule, cycle_of(rig, Request(setpoints)))) is Action.FAULT
    verdicts = words(rule, cycle_of(rig, Request((one, (0.0,) * 6))))
    assert [(v.arm, v.joint) for v in verdicts] == [(1, -1)]


@pytest.mark.parametrize(
    "request_with",
    [
        {"waypoint_due_s": math.nan},
        {"waypoint_due_s": 1},
        {"may_open_jaw": (True,)},
        {"holding": (True, False, True)},
    ],
)
def test_s01_faults_on_an_unsound_rest_of_the_request(request_with):
    rig = Rig()
    verdicts = words(made("S01"), cycle_of(rig, Request(rig.stay(), **request_with)))
    assert [(v.action, v.arm) for v in verdicts] == [(Action.FAULT, -1)]


def test_s01_leaves_a_request_without_setpoints_to_s16():
    assert words(made("S01"), cycle_of(Rig(), Request(None))) == []


STATE_FIELDS = [
    *((field, i) for field in ("measured_jp", "measured_jv", "setpoint_jp") for i in JOINTS),
    *((field, 6) for field in ("jaw_measured_jp", "jaw_measured_jv", "jaw_setpoint_jp", "stamp_s")),
]


def rig_with(arm: int, field: str, index: int, value) -> Rig:
    rig = Rig()
    old = getattr(rig.state().arms[arm], field)
    rig.broken[arm] = {field: value if index == 6 else replaced(old, index, value)}
    return rig


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize(("field", "index"), STATE_FIELDS)
@pytest.mark.parametrize("value", BAD_NUMBERS + WRONG_TYPES)
def test_s02_faults_on_any_measurement_that_is_not_a_finite_float(arm, field, index, value):
    (verdict,) = words(made("S02"), cycle_of(rig_with(arm, field, index, value)))
    assert (verdict.action, verdict.arm, verdict.joint) == (Action.FAULT, arm, index)


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize(("field", "index"), STATE_FIELDS)
@pytest.mark.parametrize("value", FINE_NUMBERS)
def test_s02_passes_finite_floats(arm, field, index, value):
    assert words(made("S02"), cycle_of(rig_with(arm, field, index, value))) == []


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("measured_jp", (0.0,) * 5),
        ("measured_jv", [0.0] * 6),
        ("setpoint_jp", None),
        ("joint_names", ("pitch", "yaw", "insertion", "roll", "wrist_pitch", "wrist_yaw")),
        ("joint_names", ()),
        ("name", "PSM3"),
        ("tool", "debakey_forceps_400036"),
    ],
)
def test_s02_faults_on_another_shape_arm_or_tool(arm, field, value):
    rig = Rig()
    rig.broken[arm] = {field: value}
    (verdict,) = words(made("S02"), cycle_of(rig))
    assert (verdict.action, verdict.arm, verdict.joint) == (Action.FAULT, arm, -1)


def test_s02_faults_on_another_number_of_arms():
    rig = Rig()
    cycle = cycle_of(rig)
    for arms in [(), cycle.state.arms[:1], list(cycle.state.arms), None]:
        cycle.state = replace(cycle.state, arms=arms)
        (verdict,) = words(made("S02"), cycle)
        assert (verdict.action, verdict.arm) == (Action.FAULT, -1)


# S03, S04: positions -------------------------------------------------------------------------

OUTSIDE = [(-1e-6, False), (0.0, False), (1e-6, True), (1e-4, True)]


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("joint", JOINTS)
@pytest.mark.parametrize("side", SIGNS)
@pytest.mark.parametrize(("beyond", "outside"), OUTSIDE)
def test_s03_holds_outside_the_margin_but_for_the_way_back(arm, joint, side, beyond, outside):
    envelope = Rig().gate.envelope.arms[arm]
    bound = (envelope.upper if side > 0 else envelope.lower)[joint] - side * envelope.margin[joint]
    q, creep = bound + side * beyond, side * 1e-8
    leaving, _ = asking(arm, joint, q, creep, creep)
    verdicts = words(made("S03"), leaving)
    assert worst(verdicts) is (Action.HOLD if outside else Action.PASS)
    assert all((v.arm, v.joint) == (arm, joint) for v in verdicts)
    for cycle in (asking(arm, joint, q, -creep, -creep)[0], asking(arm, joint, q)[0]):
        assert words(made("S03"), cycle) == []


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("joint", JOINTS)
@pytest.mark.parametrize("side", SIGNS)
def test_s03_holds_before_a_stop_would_leave_the_hard_limits(arm, joint, side):
    """At a third of full speed, the last place from which the gate can stop inside."""
    envelope = Rig().gate.envelope.arms[arm]
    v = envelope.max_speed[joint] / 3.0
    A, J = envelope.max_acceleration[joint], envelope.max_jerk[joint]
    way = v * v / (2 * A) + v * A / (2 * J) if v > A * A / J else v * math.sqrt(v / J)
    limit = (envelope.upper if side > 0 else envelope.lower)[joint]
    step = side * v * PERIOD
    just_fits, _ = asking(arm, joint, limit - side * way * 1.0001, step, step)
    too_late, _ = asking(arm, joint, limit - side * way * 0.9999, step, step)
    assert words(made("S03"), just_fits) == []
    assert worst(words(made("S03"), too_late)) is Action.HOLD


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("joint", JOINTS)
@pytest.mark.parametrize("side", SIGNS)
@pytest.mark.parametrize(("beyond", "outside"), OUTSIDE)
def test_s04_faults_on_measured_joints_beyond_the_slack(arm, joint, side, beyond, outside):
    envelope = Rig().gate.envelope.arms[arm]
    hard = (envelope.upper if side > 0 else envelope.lower)[joint]
    q = hard + side * (envelope.measured_slack + beyond)
    verdicts = words(made("S04"), cycle_of(rig_with(arm, "measured_jp", joint, q)))
    assert worst(verdicts) is (Action.FAULT if outside else Action.PASS)
    assert all((v.arm, v.joint, v.value) == (arm, joint, q) for v in verdicts)


# S05, S06, S08, S10, S30: rates --------------------------------------------------------------


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("joint", JOINTS)
@pytest.mark.parametrize("side", SIGNS)
@pytest.mark.parametrize(("factor", "action"), FACTORS)
def test_s05_scales_and_holds_by_joint_speed(arm, joint, side, factor, action):
    speed = Rig().gate.envelope.arms[arm].max_speed[joint]
    step = side * factor * speed * PERIOD
    verdicts = words(made("S05"), asking(arm, joint, 0.1, step, step)[0])
    assert worst(verdicts) is action
    for verdict in verdicts:
        assert (verdict.arm, verdict.joint) == (arm, joint)
        assert verdict.value == pytest.approx(factor * speed)
        assert verdict.limit == speed


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("joint", JOINTS)
@pytest.mark.parametrize(("factor", "action"), FACTORS)
def test_s05_judges_the_velocity_that_is_sent_along(arm, joint, factor, action):
    rig = Rig()
    speed = rig.gate.envelope.arms[arm].max_speed[joint]
    setpoints = setpoints_with(rig, arm, "jv", joint, -factor * speed)
    cycle = cycle_of(rig, Request(setpoints))
    for track, setpoint in zip(cycle.tracks, setpoints, strict=True):
        track.ask(setpoint)
    assert worst(words(made("S05"), cycle)) is action


@pytest.mark.parametrize("rate", [1.0, 0.95, 0.85, 0.7])
def test_s05_finds_a_loop_that_runs_faster_than_its_period(rate):
    """Nominal full speed sent in less true time: nothing wrong in any one cycle."""
    rule = made("S05")
    cycle, _ = asking(0, 3, 0.1, 1.0 * 18.8 * PERIOD, 18.8 * PERIOD)
    actions = []
    for k in range(2 * round(s05_joint_speed.WINDOW_S / PERIOD)):
        cycle.now = 1.0 + k * PERIOD * rate
        cycle.is_first = k == 0
        actions.append(worst(words(rule, cycle)))
    expected = {1.0: Action.PASS, 0.95: Action.SCALE, 0.85: Action.SCALE, 0.7: Action.HOLD}
    assert max(actions) is expected[rate]
    assert actions[0] is Action.PASS


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("joint", AXES)
@pytest.mark.parametrize("side", SIGNS)
@pytest.mark.parametrize(("factor", "action"), FACTORS)
def test_s06_scales_and_holds_by_acceleration(arm, joint, side, factor, action):
    limit = Rig().gate.envelope.arms[arm].max_acceleration[joint]
    bend = side * factor * limit * PERIOD**2
    verdicts = words(made("S06"), asking(arm, joint, 0.1, 0.001 + bend, 0.001)[0])
    assert worst(verdicts) is action
    for verdict in verdicts:
        assert (verdict.arm, verdict.joint) == (arm, joint)
        assert verdict.value == pytest.approx(factor * limit)


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("joint", AXES)
@pytest.mark.parametrize("side", SIGNS)
@pytest.mark.parametrize(("factor", "action"), FACTORS)
def test_s07_scales_and_holds_by_jerk(arm, joint, side, factor, action):
    limit = Rig().gate.envelope.arms[arm].max_jerk[joint]
    turn = side * factor * limit * PERIOD**3
    cycle, _ = asking(arm, joint, 0.1, 0.001 + 2e-6 + turn, 0.001, 2e-6)
    verdicts = words(made("S07"), cycle)
    assert worst(verdicts) is action
    for verdict in verdicts:
        assert (verdict.arm, verdict.joint) == (arm, joint)
        assert verdict.value == pytest.approx(factor * limit)
        assert verdict.limit == limit


@pytest.mark.parametrize("period", [0.001, 0.002, 0.004, 0.01])
def test_s07_passes_jerk_at_its_limit_in_spite_of_rounding(period):
    """Ten seconds of full jerk one way and back, at the far end of the range."""
    rig = Rig(period)
    cycle, rule = Cycle(rig.gate.envelope), RULES["S07"](rig.gate.envelope)
    track, limit = cycle.tracks[0], rig.gate.envelope.arms[0].max_jerk
    top = tuple(rig.gate.envelope.arms[0].upper)
    cycle.tracks[1].begin(rig.stay()[1])
    track.begin(JointSetpoint(top[:6], (0.0,) * 6, top[6], 0.0))
    turns = [j * period**3 for j in limit]
    step, bend, q = [0.0] * 7, [0.0] * 7, list(top)
    for k in range(1000):
        side = 1.0 if k % 8 in (0, 1, 6, 7) else -1.0
        bend = [b + side * t for b, t in zip(bend, turns, strict=True)]
        step = [s + b for s, b in zip(step, bend, strict=True)]
        q = [p + s for p, s in zip(q, step, strict=True)]
        track.ask(JointSetpoint(tuple(q[:6]), (0.0,) * 6, q[6], 0.0))
        assert words(rule, cycle) == []
        assert track.jerkiest == pytest.approx(1.0, abs=2e-7)
        track.accept()


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("joint", AXES)
@pytest.mark.parametrize("side", SIGNS)
@pytest.mark.parametrize(("factor", "holds"), [(0.5, 0), (1.0, 0), (1.000001, 1), (50.0, 1)])
def test_s08_holds_on_a_jump(arm, joint, side, factor, holds):
    jump = 2.0 * Rig().gate.envelope.arms[arm].max_speed[joint] * PERIOD
    verdicts = words(made("S08"), asking(arm, joint, 0.1, side * factor * jump)[0])
    assert worst(verdicts) is (Action.HOLD if holds else Action.PASS)
    assert all(v.limit == pytest.approx(jump) for v in verdicts)


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("joint", JOINTS)
@pytest.mark.parametrize("side", SIGNS)
@pytest.mark.parametrize(("factor", "holds"), [(0.5, 0), (1.0, 0), (1.000001, 1), (50.0, 1)])
def test_s09_holds_a_first_setpoint_far_from_the_drivers(arm, joint, side, factor, holds):
    limit = Rig().gate.envelope.arms[arm].first_command[joint]
    cycle, _ = asking(arm, joint, 0.1)
    states = list(cycle.state.arms)
    held = replaced(cycle.tracks[arm].asked.jp, joint, 0.1 + side * factor * limit)
    states[arm] = replace(states[arm], setpoint_jp=held)
    cycle.state = replace(cycle.state, arms=tuple(states))
    cycle.is_first = True
    verdicts = words(made("S09"), cycle)
    assert worst(verdicts) is (Action.HOLD if holds else Action.PASS)
    assert all((v.arm, v.joint) == (arm, joint) for v in verdicts)
    cycle.is_first = False
    assert words(made("S09"), cycle) == []


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("side", SIGNS)
@pytest.mark.parametrize(
    ("speed", "action"),
    [
        (0.03, Action.PASS),
        (0.05, Action.PASS),
        (0.050001, Action.SCALE),
        (0.06, Action.SCALE),
        (0.0601, Action.HOLD),
        (0.25, Action.HOLD),
        (0.2501, Action.STOP),
        (2.0, Action.STOP),
    ],
)
def test_s10_by_speed_of_the_control_point(arm, side, speed, action):
    """Plain insertion moves the control point at the joint's own speed."""
    verdicts = words(made("S10"), asking(arm, 2, 0.1, side * speed * PERIOD)[0])
    assert worst(verdicts) is action
    assert all(v.value == pytest.approx(speed) and v.arm == arm for v in verdicts)


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("side", SIGNS)
@pytest.mark.parametrize("along", [False, True])
@pytest.mark.parametrize(("factor", "holds"), [(0.5, 0), (1.0, 0), (1.000001, 1), (50.0, 1)])
def test_s30_holds_on_jaw_speed(arm, side, along, factor, holds):
    speed = side * factor * 6.0
    cycle, _ = asking(arm, 6, 0.3, 0.0 if along else speed * PERIOD)
    track = cycle.tracks[arm]
    if along:
        track.asked = replace(track.asked, jaw_v=speed)
    verdicts = words(made("S30"), cycle)
    assert worst(verdicts) is (Action.HOLD if holds else Action.PASS)
    assert all(v.joint == 6 and v.value == pytest.approx(abs(speed)) for v in verdicts)


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("side", SIGNS)
@pytest.mark.parametrize(("beyond", "outside"), [(-1e-6, False), (0.0, False), (1e-6, True)])
def test_s30_holds_outside_the_jaws_range_but_for_the_way_back(arm, side, beyond, outside):
    envelope = Rig().gate.envelope.arms[arm]
    jaw = (envelope.upper if side > 0 else envelope.lower)[6] + side * beyond
    verdicts = words(made("S30"), asking(arm, 6, jaw, side * 1e-7)[0])
    assert worst(verdicts) is (Action.HOLD if outside else Action.PASS)
    assert words(made("S30"), asking(arm, 6, jaw, -side * 1e-7)[0]) == []
    assert words(made("S30"), asking(arm, 6, jaw)[0]) == []


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize(
    ("holding", "may_open", "opens"),
    [
        (True, False, False),
        (True, True, True),
        (False, False, True),
        (False, True, True),
        (None, None, False),
        (None, True, True),
    ],
)
def test_s30_a_slow_creep_does_not_open_a_jaw_that_holds(arm, holding, may_open, opens):
    rule, creep = made("S30"), 0.001
    said = {
        "holding": () if holding is None else (holding,) * 2,
        "may_open_jaw": () if may_open is None else (may_open,) * 2,
    }
    actions = []
    for k in range(1, 26):
        cycle, _ = asking(arm, 6, 0.1 + k * creep, creep)
        cycle.request = replace(cycle.request, **said)
        actions.append(worst(words(rule, cycle)))
    assert actions[:20] == [Action.PASS] * 20
    assert actions[20:] == [Action.PASS if opens else Action.HOLD] * 5


# S11, S13: places ----------------------------------------------------------------------------


def pushed(arm: int, axis: int, side: float, beyond: float, step: float) -> Cycle:
    """The control point `beyond` a wall, having moved `step` along the axis."""
    cycle, _ = asking(arm, 2, 0.1)
    track = cycle.tracks[arm]
    box = track.envelope.workspace_lower, track.envelope.workspace_upper
    middle = [0.5 * (low + high) for low, high in zip(*box, strict=True)]
    for point, back in (("asked_point", 0.0), ("point", step)):
        place = list(middle)
        place[axis] = box[side > 0][axis] + side * (beyond - back)
        setattr(track, point, tuple(place))
    track.jaw_end = track.asked_jaw_end = (0.0, 0.0, 0.05)
    if step:
        track.asked_q = replaced(track.asked_q, 0, track.q[0] + 1e-3)
    return cycle


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("side", SIGNS)
@pytest.mark.parametrize(
    ("beyond", "outside"), [(-1e-6, False), (0.0, False), (1e-6, True), (0.1, True)]
)
def test_s11_holds_outside_the_workspace_but_for_the_way_back(arm, axis, side, beyond, outside):
    verdicts = words(made("S11"), pushed(arm, axis, side, beyond, 1e-5))
    assert worst(verdicts) is (Action.HOLD if outside else Action.PASS)
    assert all(v.arm == arm and v.value == pytest.approx(beyond, rel=0.01) for v in verdicts)
    assert words(made("S11"), pushed(arm, axis, side, beyond, -1e-5)) == []
    assert words(made("S11"), pushed(arm, axis, side, beyond, 0.0)) == []


@pytest.mark.parametrize("arm", ARMS)
def test_s11_holds_a_slide_along_the_outside_of_a_wall(arm):
    cycle = pushed(arm, 0, 1.0, 0.01, 1e-5)
    cycle.tracks[arm].point = cycle.tracks[arm].asked_point
    assert worst(words(made("S11"), cycle)) is Action.HOLD


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize(("depth", "holds"), [(-1e-6, 0), (0.0, 0), (1e-6, 1), (0.01, 1)])
def test_s11_holds_before_a_jaw_end_enters_the_floor(arm, depth, holds):
    cycle = pushed(arm, 2, 1.0, -0.01, 1e-5)
    track = cycle.tracks[arm]
    track.jaw_end, track.asked_jaw_end = (0.0, 0.0, 1e-3), (0.0, 0.0, -depth)
    assert worst(words(made("S11"), cycle)) is (Action.HOLD if holds else Action.PASS)


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("joint", JOINTS)
@pytest.mark.parametrize("side", SIGNS)
def test_s13_in_the_cannula_only_a_plain_insertion_passes(arm, joint, side):
    rig = Rig()
    least = rig.gate.envelope.arms[arm].insertion_min
    for insertion in (least, least - 1e-6):
        jp = replaced(rig.held[arm].jp, 2, insertion)
        rig.held = replaced(rig.held, arm, JointSetpoint(jp, (0.0,) * 6, 0.3, 0.0))
        cycle = cycle_of(rig)
        moved = rig.moved(arm, joint, side * (1e-7 if joint == 2 else 1e-3))
        for track, setpoint in zip(cycle.tracks, moved, strict=True):
            track.ask(setpoint)
        free = joint == 2 and side > 0
        inside = insertion < least or (joint == 2 and side < 0)
        verdicts = words(made("S13"), cycle)
        assert worst(verdicts) is (Action.HOLD if inside and not free else Action.PASS)
        assert all((v.arm, v.joint, v.limit) == (arm, 2, least) for v in verdicts)


def test_s13_lets_an_arm_rest_in_the_cannula_and_use_its_jaw():
    cycle, _ = asking(0, 2, 0.01)
    assert words(made("S13"), cycle) == []
    cycle.tracks[0].asked_q = replaced(cycle.tracks[0].asked_q, 6, 0.35)
    assert words(made("S13"), cycle) == []


# S17, S22: where the arms are, and who agrees ------------------------------------------------


def tracked(rig: Rig, rule, arm: int, joint: int, error: float, times: int, dt=PERIOD) -> list:
    """Actions of S17 while one joint is measured `error` away from its setpoint."""
    actions = []
    cycle = cycle_of(rig)
    cycle.is_first = False
    for _ in range(times):
        measured = rig.held[arm].jp[joint] + error
        rig.broken[arm] = {"measured_jp": replaced(rig.held[arm].jp, joint, measured)}
        rig.now += dt
        cycle.begin(rig.state(), Request(rig.stay()), rig.now)
        verdicts = words(rule, cycle)
        for verdict in verdicts:
            assert (verdict.arm, verdict.joint) == (arm, joint)
            assert verdict.value == pytest.approx(abs(error))
            assert verdict.limit == rig.gate.envelope.arms[arm].tracking[joint]
        actions.append(worst(verdicts))
    return actions


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("joint", JOINTS)
@pytest.mark.parametrize("side", SIGNS)
@pytest.mark.parametrize(
    ("part", "action"),
    [
        (0.5, Action.PASS),
        (1.0, Action.PASS),
        (1.000001, Action.STOP),
        (2.0, Action.STOP),
        (2.000001, Action.FAULT),
        (50.0, Action.FAULT),
    ],
)
def test_s17_stops_and_faults_on_a_tracking_error_that_lasts(arm, joint, side, part, action):
    rig = Rig()
    error = side * part * rig.gate.envelope.arms[arm].tracking[joint]
    actions = tracked(rig, made("S17"), arm, joint, error, 20)
    assert actions[:12] == [Action.PASS] * 12  # 48 ms
    assert actions[12:] == [action] * 8


def test_s17_tolerances_are_those_of_the_arms_file():
    tracking = Rig().gate.envelope.arms[0].tracking
    assert tracking == (0.05, 0.05, 0.003, 0.1, 0.1, 0.1)


@pytest.mark.parametrize(("off", "on", "stops"), [(10, 60, False), (10, 12, True), (12, 1, True)])
def test_s17_an_error_that_comes_and_goes_still_acts(off, on, stops):
    """It gives its time back four times slower than it spends it."""
    rig, rule, actions = Rig(), made("S17"), []
    for _ in range(10):
        actions += tracked(rig, rule, 0, 1, 0.06, off)
        actions += tracked(rig, rule, 0, 1, 0.01, on)
    assert (Action.STOP in actions) is stops


def test_s17_one_sample_after_a_pause_counts_for_the_whole_pause():
    assert tracked(Rig(), made("S17"), 0, 0, 0.06, 1, dt=0.0501) == [Action.STOP]
    assert tracked(Rig(), made("S17"), 0, 0, 0.06, 1, dt=0.05) == [Action.PASS]


@pytest.mark.parametrize("arm", ARMS)
def test_s17_does_not_look_at_the_jaw(arm):
    rig = Rig()
    rig.broken[arm] = {"jaw_measured_jp": 1.0}
    rule, cycle = made("S17"), cycle_of(rig)
    for _ in range(30):
        assert words(rule, cycle) == []


def test_s17_a_far_error_is_a_fault_once_it_lasts_itself():
    rig, rule = Rig(), made("S17")
    actions = tracked(rig, rule, 0, 0, 0.06, 20) + tracked(rig, rule, 0, 0, 0.2, 14)
    assert actions[12:32] == [Action.STOP] * 20
    assert actions[32:] == [Action.FAULT] * 2


@pytest.mark.parametrize("arm", ARMS)
def test_s17_is_a_fault_when_it_has_ended_a_run_before(arm):
    rule, cycle = made("S17"), cycle_of(rig_with(arm, "measured_jp", 0, 0.9))
    cycle.dt = 0.06
    for before, action in [((), Action.STOP), (("S10",), Action.STOP), (("S17",), Action.FAULT)]:
        rule, cycle.stopped_before = made("S17"), frozenset(before)
        cycle.tracks[arm].q = replaced(cycle.tracks[arm].q, 0, 0.82)
        assert worst(words(rule, cycle)) is action


SILENCE = [
    (0.0, Action.PASS),
    (0.1, Action.PASS),
    (0.2, Action.PASS),
    (0.2001, Action.HOLD),
    (2.0, Action.HOLD),
    (2.0001, Action.STOP),
    (1e9, Action.STOP),
]


def consented(rig: Rig) -> tuple:
    """The rule and a cycle in which the operator has just agreed."""
    rig.consent = True
    cycle, rule = cycle_of(rig), made("S22")
    assert words(rule, cycle) == []
    cycle.is_first = False
    return rule, cycle


def later(rig: Rig, cycle: Cycle, dt: float = PERIOD) -> Cycle:
    rig.now += dt
    cycle.begin(rig.state(), Request(rig.stay()), rig.now)
    return cycle


@pytest.mark.parametrize("side", SIGNS)
@pytest.mark.parametrize(("age", "action"), SILENCE)
def test_s22_by_the_age_of_a_streamed_word_before_or_ahead_of_the_clock(side, age, action):
    rig = Rig()
    rule, cycle = consented(rig)
    rig.now += age
    rig.said = {"consent_stamp_s": rig.now - side * age}
    verdicts = words(rule, later(rig, cycle, 0.0))
    assert worst(verdicts) is action
    assert all(v.value == pytest.approx(age) and v.arm == -1 for v in verdicts)


@pytest.mark.parametrize("what", ["alive", "arm 0", "arm 1"])
@pytest.mark.parametrize(("age", "action"), SILENCE)
def test_s22_an_old_edge_is_good_while_its_publisher_and_the_arms_live(what, age, action):
    rig = Rig()
    rig.said = {"consent_is_streamed": False, "consent_stamp_s": 0.0, "consent_alive_s": rig.now}
    rule, cycle = consented(rig)
    rig.now += age
    if what == "alive":
        rig.said["consent_alive_s"] = rig.now - age
    else:
        rig.said["consent_alive_s"] = rig.now
        rig.broken[int(what[-1])] = {"stamp_s": rig.now - age}
    assert worst(words(rule, later(rig, cycle, 0.0))) is action


def test_s22_a_streamed_word_does_not_need_the_arms():
    rig = Rig()
    rule, cycle = consented(rig)
    rig.broken[0] = {"stamp_s": rig.now - 1.0}
    assert words(rule, later(rig, cycle)) == []


@pytest.mark.parametrize("streamed", [False, None, 1, "yes"])
def test_s22_a_source_that_is_not_known_to_repeat_its_word_has_to_show_that_it_lives(streamed):
    rig = Rig()
    rule, cycle = consented(rig)
    rig.said = {"consent_is_streamed": streamed}
    assert worst(words(rule, later(rig, cycle))) is Action.HOLD
    rig.said["consent_alive_s"] = rig.now + PERIOD
    assert words(rule, later(rig, cycle)) == []


@pytest.mark.parametrize("consent", [False, None, 1, "yes", np.True_])
def test_s22_holds_at_once_when_consent_is_withdrawn_and_stops_after_two_seconds(consent):
    rig = Rig()
    rule, cycle = consented(rig)
    rig.consent, start, first = consent, rig.now, {}
    for _ in range(600):
        (verdict,) = words(rule, later(rig, cycle))
        first.setdefault(verdict.action, verdict)
    assert first[Action.HOLD].value == pytest.approx(PERIOD)
    assert first[Action.HOLD].limit == 0.0
    assert first[Action.STOP].value == pytest.approx(2.0, abs=1.01 * PERIOD)
    assert list(first) == [Action.HOLD, Action.STOP]
    rig.consent = True
    assert words(rule, later(rig, cycle)) == []
    assert rig.now > start


def test_s22_consent_comes_from_the_source_that_the_run_began_with():
    rig = Rig()
    rule, cycle = consented(rig)
    rig.said = {"consent_source": "pedal"}
    (verdict,) = words(rule, later(rig, cycle))
    assert (verdict.action, verdict.limit) == (Action.HOLD, 0.0)
    cycle.is_first = True  # an operator has resumed, with the pedal
    assert words(rule, later(rig, cycle)) == []


@pytest.mark.parametrize("streamed", [True, False])
@pytest.mark.parametrize("field", ["consent_stamp_s", "consent_alive_s"])
@pytest.mark.parametrize("value", BAD_NUMBERS + WRONG_TYPES)
def test_s22_a_stamp_that_is_no_finite_float_is_no_consent(streamed, field, value):
    rig = Rig()
    rig.said = {"consent_is_streamed": streamed, "consent_alive_s": rig.now}
    rule, cycle = consented(rig)
    rig.said = {**rig.said, "consent_alive_s": rig.now + PERIOD, field: value}
    matters = field == "consent_stamp_s" or not streamed
    assert worst(words(rule, later(rig, cycle))) is (Action.HOLD if matters else Action.PASS)


def test_s22_does_not_arm_without_ever_having_heard_a_fresh_word():
    rig = Rig()
    rig.consent, rig.said = True, {"consent_stamp_s": rig.now - 1.0}
    assert worst(words(made("S22"), cycle_of(rig))) >= Action.HOLD


# S15: singularities, and tips off their path --------------------------------------------------


@cache
def depth_of(arm: int, value: float) -> float:
    """Insertion at which the smallest singular value is `value`, the other joints at home."""
    envelope, low, high = Rig().gate.envelope.arms[arm], 0.016, 0.2
    for _ in range(60):
        middle = 0.5 * (low + high)
        q = replaced(Rig().held[arm].jp, 2, middle)
        is_deep = s15_conditioning.smallest_singular_value(envelope, q) > value
        low, high = (low, middle) if is_deep else (middle, high)
    return high


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("step", [-1e-4, -1e-6, 0.0, 1e-6, 1e-4])
@pytest.mark.parametrize(
    ("value", "action"),
    [
        (0.08, Action.PASS),
        (0.025 + 1e-7, Action.PASS),
        (0.025 - 1e-7, Action.SCALE),
        (0.02, Action.SCALE),
        (0.015 + 1e-7, Action.SCALE),
        (0.015 - 1e-7, Action.HOLD),
        (0.01, Action.HOLD),
        (0.001, Action.HOLD),
    ],
)
def test_s15_slows_and_holds_on_the_way_to_a_singularity_only(arm, step, value, action):
    cycle, _ = asking(arm, 2, depth_of(arm, value), step)
    verdicts = words(made("S15"), cycle)
    assert worst(verdicts) is (action if step < 0.0 else Action.PASS)
    for verdict in verdicts:
        assert verdict.arm == arm
        assert verdict.value == pytest.approx(1.0 / value, rel=1e-6)
        assert verdict.limit == pytest.approx(40.0 if action is Action.SCALE else 1.0 / 0.015)


def test_s15_a_jacobian_that_is_no_matrix_of_numbers_holds():
    for far in (1e300, 1.7e308):
        cycle, _ = asking(0, 2, 0.1)
        track = cycle.tracks[0]
        track.asked_q = replaced(track.asked_q, 2, far)
        track.envelope = replace(track.envelope, chain=Overflowing(track.envelope.chain, far))
        (verdict,) = words(made("S15"), cycle)
        assert (verdict.action, verdict.value) == (Action.HOLD, math.inf)


class Overflowing:
    """A chain whose numbers run over when a joint is somewhere absurd."""

    def __init__(self, chain, far: float) -> None:
        self.chain, self.far = chain, far

    def jacobian(self, q):
        columns = self.chain.jacobian(q)
        return [[math.inf] * 6] * 6 if q[2] == self.far else columns


@pytest.mark.parametrize("seed", range(20))
def test_s15_what_was_seen_before_never_hides_a_small_singular_value(seed):
    """A walk through all configurations past the cannula: the bound keeps under the truth."""
    rng, rule = np.random.default_rng(seed), made("S15")
    cycle, envelope = asking(0, 2, 0.1)
    track, arm = cycle.tracks[0], envelope.arms[0]
    low, high = np.array(arm.lower[:6]), np.array(arm.upper[:6])
    low[2] = arm.insertion_min
    q, way, looks = rng.uniform(low, high), rng.normal(size=6), 0
    for _ in range(150):
        way = 0.95 * way + 0.3 * rng.normal(size=6)
        q = np.clip(q + 4e-3 * way * [1.0, 1.0, 0.1, 3.0, 3.0, 3.0], low, high)
        track.ask(JointSetpoint((*q.tolist(),), (0.0,) * 6, 0.3, 0.0))
        true = s15_conditioning.smallest_singular_value(arm, track.asked_q) / arm.slow_value - 1.0
        margin = rule.margin(cycle)
        looks += rule._at[0] == track.asked_q
        if true > 0.0:
            assert min(true / 3.0, 1.0) - 1e-9 <= margin <= true + 1e-9
        track.accept()
    assert looks > 0


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("side", SIGNS)
@pytest.mark.parametrize(
    ("off", "holds"), [(0.0, 0), (0.0005, 0), (0.001, 0), (0.001001, 1), (0.1, 1), (1e300, 1)]
)
def test_s15_holds_a_tip_that_is_off_its_path(arm, axis, side, off, holds):
    cycle, _ = asking(arm, 2, 0.1)
    tips = [track.asked_point for track in cycle.tracks]
    tips[arm] = replaced(tips[arm], axis, tips[arm][axis] + side * off)
    cycle.request = replace(cycle.request, tips=tuple(tips))
    verdicts = words(made("S15"), cycle)
    assert worst(verdicts) is (Action.HOLD if holds else Action.PASS)
    assert all(v.arm == arm and v.value == pytest.approx(off, rel=1e-6) for v in verdicts)
    assert all(v.limit == 0.001 for v in verdicts)


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("value", BAD_NUMBERS + WRONG_TYPES)
def test_s01_faults_on_a_tip_that_is_no_point(arm, axis, value):
    rig = Rig()
    tips = replaced(((0.0, 0.0, 0.1),) * 2, arm, replaced((0.0, 0.0, 0.1), axis, value))
    verdicts = words(made("S01"), cycle_of(rig, Request(rig.stay(), tips=tips)))
    assert [(v.action, v.arm) for v in verdicts] == [(Action.FAULT, -1)]


@pytest.mark.parametrize(
    "tips",
    [
        None,
        0.0,
        [(0.0, 0.0, 0.1)] * 2,
        ((0.0, 0.0, 0.1),),
        ((0.0, 0.0, 0.1),) * 3,
        ((0.0, 0.0), (0.0, 0.0, 0.1)),
        ((0.0, 0.0, 0.1, 0.0), (0.0, 0.0, 0.1)),
        ([0.0, 0.0, 0.1], (0.0, 0.0, 0.1)),
        (np.zeros(3), (0.0, 0.0, 0.1)),
        ("000", (0.0, 0.0, 0.1)),
    ],
)
def test_s01_faults_on_tips_of_a_wrong_shape(tips):
    rig = Rig()
    verdicts = words(made("S01"), cycle_of(rig, Request(rig.stay(), tips=tips)))
    assert [(v.action, v.arm) for v in verdicts] == [(Action.FAULT, -1)]


def test_s01_passes_one_tip_an_arm():
    rig = Rig()
    cycle = cycle_of(rig, Request(rig.stay(), tips=((0.0, -0.0, 0.1), (5e-324, 1.0, 2.0))))
    assert words(made("S01"), cycle) == []


# S16 - S24, S32: the line, time, the robot ----------------------------------------------------


def test_s16_holds_and_faults_at_the_third_miss_in_a_row():
    rig, rule = Rig(), made("S16")
    missing, there = cycle_of(rig, Request(None, failure="infeasible")), cycle_of(rig)
    pattern = [missing, missing, there, missing, missing, missing, missing]
    actions = [worst(words(rule, cycle)) for cycle in pattern]
    H, F, P = Action.HOLD, Action.FAULT, Action.PASS
    assert actions == [H, H, P, H, H, F, F]


def test_s16_counts_silence_only_while_the_arms_are_meant_to_move():
    cycle, rule = cycle_of(Rig(), Request(None)), made("S16")
    assert worst(words(rule, cycle)) is Action.HOLD
    cycle.is_stopping = True
    assert words(rule, cycle) == []


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("side", SIGNS)
@pytest.mark.parametrize(
    ("age", "action"),
    [
        (0.0, Action.PASS),
        (0.05, Action.PASS),
        (0.0501, Action.HOLD),
        (0.1, Action.HOLD),
        (0.1001, Action.FAULT),
        (1e9, Action.FAULT),
    ],
)
def test_s18_by_age_of_the_stamp_before_or_ahead_of_the_clock(arm, side, age, action):
    rig = Rig()
    rig.broken[arm] = {"stamp_s": rig.now - side * age}
    verdicts = words(made("S18"), cycle_of(rig))
    assert worst(verdicts) is action
    assert all(v.arm == arm for v in verdicts)


def test_s18_waits_five_periods_of_slow_feedback():
    rig = Rig()
    arms = tuple(replace(arm, feedback_period=0.02) for arm in rig.gate.envelope.arms)
    rule = RULES["S18"](replace(rig.gate.envelope, arms=arms))
    for age, action in [(0.1, Action.PASS), (0.11, Action.HOLD), (0.21, Action.FAULT)]:
        rig.broken[0] = {"stamp_s": rig.now - age}
        assert worst(words(rule, cycle_of(rig))) is action


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("joint", JOINTS)
@pytest.mark.parametrize(
    ("part", "after_s", "action"),
    [
        (0.99, 9.0, Action.PASS),
        (1.01, 0.05, Action.PASS),
        (1.01, 0.0501, Action.HOLD),
        (1.01, 0.1001, Action.FAULT),
    ],
)
def test_s18_by_frozen_numbers_while_the_setpoint_moves(arm, joint, part, after_s, action):
    rig, rule = Rig(), made("S18")
    cycle = cycle_of(rig)
    assert words(rule, cycle) == []
    moved = s18_feedback_age.MOVED[joint == 2] * part
    track = cycle.tracks[arm]
    track.q = replaced(track.q, joint, track.q[joint] + moved)
    rig.now += after_s
    cycle.begin(rig.state(), Request(rig.stay()), rig.now)  # the same numbers, a fresh stamp
    assert worst(words(rule, cycle)) is action


@pytest.mark.parametrize(
    ("overdue", "action"),
    [
        (-math.inf, Action.PASS),
        (-1.0, Action.PASS),
        (0.0, Action.PASS),
        (0.1, Action.PASS),
        (0.100001, Action.HOLD),
        (math.inf, Action.HOLD),
    ],
)
def test_s19_holds_when_the_next_waypoint_is_late(overdue, action):
    rig = Rig()
    cycle = cycle_of(rig, Request(rig.stay(), waypoint_due_s=rig.now - overdue))
    assert worst(words(made("S19"), cycle)) is action


def test_s20_warns_and_holds_at_the_third_overrun_in_a_second():
    rig, rule = Rig(), made("S20")
    cycle = cycle_of(rig)
    cycle.is_first = False
    actions = []
    for dt in [0.004, 0.012, 0.0121, 0.004, 0.02, 0.004, 0.013, 1.2, 0.013]:
        cycle.begin(cycle.state, cycle.request, cycle.now + dt)
        actions.append(worst(words(rule, cycle)))
    P, W, H = Action.PASS, Action.WARN, Action.HOLD
    assert actions == [P, P, W, P, W, P, H, H, W]


@pytest.mark.parametrize(
    ("gap", "action"),
    [(0.012, Action.PASS), (0.0499, Action.WARN), (0.05, Action.HOLD), (3600.0, Action.HOLD)],
)
def test_s20_holds_after_a_gap_in_which_a_heartbeat_would_be_lost(gap, action):
    cycle = cycle_of(Rig())
    cycle.dt = gap
    assert worst(words(made("S20"), cycle)) is action


@pytest.mark.parametrize("now", [0.999999, -1.0, math.nan, math.inf, -math.inf])
def test_s21_faults_when_the_clock_goes_back_or_is_no_number(now):
    rig = Rig()
    cycle = cycle_of(rig)
    cycle.begin(rig.state(), Request(rig.stay()), now)
    assert worst(words(made("S21"), cycle)) is Action.FAULT
    assert cycle.now == rig.now


@pytest.mark.parametrize("gap", [0.5, 3600.0, 86400.0, math.inf, math.nan])
def test_s21_faults_when_the_clock_leaps(gap):
    cycle = cycle_of(Rig())
    cycle.dt = gap
    (verdict,) = words(made("S21"), cycle)
    assert (verdict.action, verdict.limit) == (Action.FAULT, 0.5)
    assert verdict.value == pytest.approx(gap, nan_ok=True)


@pytest.mark.parametrize("gap", [0.0, 0.004, 0.4999])
def test_s21_leaves_a_late_cycle_to_s20(gap):
    cycle = cycle_of(Rig())
    cycle.dt = gap
    assert words(made("S21"), cycle) == []


def test_s21_passes_time_that_stands_still_or_goes_on():
    rig = Rig()
    cycle = cycle_of(rig)
    for now in (rig.now, rig.now + 1e-9, rig.now + 100.0):
        cycle.begin(rig.state(), Request(rig.stay()), now)
        assert words(made("S21"), cycle) == []


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("operating_state", s) for s in ("DISABLED", "PAUSED", "FAULT", "", "enabled", None)),
        *((f, v) for f in ("is_homed", "valid") for v in (False, None, 1, "yes")),
    ],
)
def test_s23_faults_on_anything_but_an_able_arm(arm, field, value):
    rig = Rig()
    rig.broken[arm] = {field: value}
    (verdict,) = words(made("S23"), cycle_of(rig))
    assert (verdict.action, verdict.arm) == (Action.FAULT, arm)


@pytest.mark.parametrize("estop", [True, None, 1, "pressed"])
def test_s23_anything_but_a_clear_no_is_an_emergency_stop(estop):
    rig = Rig()
    rig.estop = estop
    assert worst(words(made("S23"), cycle_of(rig))) is Action.ESTOP


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("joint", AXES)
@pytest.mark.parametrize("side", SIGNS)
@pytest.mark.parametrize(("part", "foreign"), [(0.5, 0), (0.999, 0), (1.001, 1), (100.0, 1)])
def test_s24_faults_on_a_setpoint_that_is_not_ours(arm, joint, side, part, foreign):
    rig = Rig()
    of_joint = s24_driver.TOLERANCE[joint == 2]
    tolerance = of_joint if joint < 6 else s24_driver.JAW_TOLERANCE
    other = rig.moved(arm, joint, side * part * tolerance)[arm]
    rig.broken[arm] = {"setpoint_jp": other.jp, "jaw_setpoint_jp": other.jaw}
    verdicts = words(made("S24"), cycle_of(rig))
    assert worst(verdicts) is (Action.FAULT if foreign else Action.PASS)
    assert all(v.arm == arm and v.value == pytest.approx(part) for v in verdicts)


def test_s24_knows_setpoints_that_are_two_feedback_periods_old_and_no_older():
    rig = Rig()
    cycle = cycle_of(rig)
    first = rig.stay()[0]
    for k in range(1, 8):
        cycle.tracks[0].ask(rig.moved(0, 0, 0.02 * k)[0])
        cycle.tracks[0].accept()
        now = rig.now + k * PERIOD
        rig.broken[0] = {"setpoint_jp": first.jp, "stamp_s": now}
        cycle.begin(rig.state(), Request(rig.stay()), now)
        assert worst(words(made("S24"), cycle)) is (Action.FAULT if k > 5 else Action.PASS)


@pytest.mark.parametrize(("late", "foreign"), [(0, 0), (10, 0), (25, 0), (-1, 1)])
def test_s24_holds_an_old_sample_against_what_was_sent_before_it(late, foreign):
    rig = Rig()
    cycle = cycle_of(rig)
    for k in range(1, 31):
        cycle.tracks[0].ask(rig.moved(0, 0, 0.02 * k)[0])
        cycle.tracks[0].accept()
    now = rig.now + 30 * PERIOD
    held = rig.moved(0, 0, 0.02 * (30 - max(late, 10)))[0]
    rig.broken[0] = {"setpoint_jp": held.jp, "stamp_s": now - late * PERIOD}
    if late == 0:
        rig.broken[0]["setpoint_jp"] = rig.moved(0, 0, 0.02 * 26)[0].jp
    cycle.begin(rig.state(), Request(rig.stay()), now)
    assert worst(words(made("S24"), cycle)) is (Action.FAULT if foreign else Action.PASS)


def test_s24_still_knows_what_was_sent_last_after_a_long_time():
    rig = Rig()
    cycle = cycle_of(rig)
    for k in range(200):
        cycle.tracks[0].ask(rig.moved(0, 0, 0.02 * k)[0])
        cycle.tracks[0].accept()
        late = rig.moved(0, 0, 0.02 * max(k - 3, 0))[0]
        rig.broken[0] = {"setpoint_jp": late.jp, "stamp_s": rig.now + k * PERIOD}
        cycle.begin(rig.state(), Request(rig.stay()), rig.now + k * PERIOD)
        assert worst(words(made("S24"), cycle)) is Action.PASS


@pytest.mark.parametrize("rule_id", sorted(RULES))
def test_a_rule_that_breaks_without_a_word_is_a_fault(rule_id):
    class Mute:
        id = rule_id
        needs = Needs.NOTHING

        def judge(self, cycle):
            yield from ()

    (verdict,) = verdicts_of(Mute(), cycle_of(Rig()))
    assert (verdict.rule, verdict.action) == (rule_id, Action.FAULT)
