"""Exact borders, and the shortcuts of rules: how little they look at is a part of what they do."""

import math
import random
from dataclasses import replace
from math import inf
from types import SimpleNamespace

import pytest
from gate_rig import CELL, PERIOD, RULES, Rig, words

from viskill_deploy.core.cell_files import Clearance, KeepOut
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.types import (
    Action,
    JointSetpoint,
    Mode,
    ObservationRange,
    Request,
    Verdict,
)
from viskill_deploy.safety import stopping
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import ROUNDING, CellEnvelope
from viskill_deploy.safety.reach import Reach
from viskill_deploy.safety.rules import (
    s12_port,
    s14_distance,
    s15_conditioning,
    s24_driver,
    s29_training_range,
)
from viskill_deploy.safety.scaling import scale_or_hold
from viskill_deploy.safety.stopping import CommonStop
from viskill_deploy.safety.supervisor import CLEAN_S
from viskill_deploy.safety.track import ArmTrack

ARM = Rig().gate.envelope.arms[0]


def at(q: dict[int, float], step: dict[int, float] | None = None) -> Cycle:
    """Both arms at home; joints of the first at `q`, having moved there evenly by `step`."""
    rig, step = Rig(), step or {}
    cycle = Cycle(rig.gate.envelope)
    cycle.begin(rig.state(), Request(rig.stay()), rig.now)
    for track, stay in zip(cycle.tracks, rig.stay(), strict=True):
        own = q if track.index == 0 else {}
        by = step if track.index == 0 else {}
        jp = tuple(own.get(j, x) for j, x in enumerate(stay.jp))
        before = tuple(x - by.get(j, 0.0) for j, x in enumerate(jp))
        track.begin(JointSetpoint(before, (0.0,) * 6, stay.jaw, 0.0))
        track.step[:6] = [by.get(j, 0.0) for j in range(6)]
        track.ask(JointSetpoint(jp, (0.0,) * 6, stay.jaw, 0.0))
    return cycle


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("beyond", [0.0, 1e-3])
@pytest.mark.parametrize("side", ["lower", "upper"])
def test_s03_lets_an_arm_rest_at_a_limit_and_beyond(joint, beyond, side):
    sign = -1.0 if side == "lower" else 1.0
    cycle = at({joint: getattr(ARM, side)[joint] + sign * beyond})
    assert words(RULES["S03"](cycle.envelope), cycle) == []


def looked_at(rule, cycle: Cycle) -> int:
    """How many joints S03 has worked out the stop of."""
    seen = []
    rule._is_leaving = lambda track, joint: seen.append(joint)
    assert rule.margin(cycle) >= 0.0
    return len(seen)


@pytest.mark.parametrize("joint", [0, 1, 2, 3])
@pytest.mark.parametrize("speed", [0.01, 0.05, 0.1])
def test_s03_works_stops_out_only_where_one_could_end_at_a_limit(joint, speed):
    step = speed * ARM.max_speed[joint] * PERIOD
    low, high = ARM.lower[joint] + ARM.margin[joint], ARM.upper[joint] - ARM.margin[joint]
    rule = RULES["S03"](Rig().gate.envelope)
    _, time = Reach(ARM, PERIOD).speed_and_time(speed, 0.0)
    ranges = [b - a for a, b in zip(ARM.lower, ARM.upper, strict=True)]
    ramp = max(4.0 * v / width for v, width in zip(ARM.max_speed, ranges, strict=True))
    part = 1.0 - speed * ramp * time
    for over, looks in ((-1e-3, 0), (1e-3, 6)):
        q = 0.5 * (low + high) + 0.5 * (high - low) * (part + over)
        assert looked_at(rule, at({joint: q}, {joint: step})) == looks


def test_s03_does_not_work_a_stop_out_at_the_very_border():
    cycle = at({})
    rule = RULES["S03"](cycle.envelope)
    rule._inner = [SimpleNamespace(farthest=lambda q: 0.5)] * 2
    rule._reaches = [SimpleNamespace(speed_and_time=lambda v, a: (0.5, 1.0))] * 2
    rule._ramps = (1.0, 1.0)
    assert looked_at(rule, cycle) == 0


def test_s04_blames_joints_beyond_their_border_alone():
    rig = Rig()
    cycle = Cycle(rig.gate.envelope)
    cycle.begin(rig.state(), Request(rig.stay()), rig.now)
    rule = RULES["S04"](cycle.envelope)
    rule._arms = [SimpleNamespace(parts=lambda q: [1.0, 1.5, 0.5], nearest=lambda j, q: 7.0)]
    cycle.state = replace(cycle.state, arms=cycle.state.arms[:1])
    (verdict,) = rule.judge(cycle)
    assert (verdict.joint, verdict.limit, verdict.action) == (1, 7.0, Action.FAULT)


def one_arm(**track: object) -> SimpleNamespace:
    """A cycle with one arm, of which a rule sees nothing but these."""
    return SimpleNamespace(tracks=[SimpleNamespace(index=0, **track)])


@pytest.mark.parametrize(
    ("part", "action"),
    [(1.0, None), (1.0000001, Action.SCALE), (1.2, Action.SCALE), (1.2000001, Action.HOLD)],
)
def test_a_little_over_a_limit_scales_from_the_limit_itself_to_a_fifth_over_it(part, action):
    said = list(scale_or_hold("S05", 1, 2, part, 4.0))
    assert [v.action for v in said] == [action] * (action is not None)
    assert [(v.rule, v.arm, v.joint, v.value, v.limit) for v in said] == [
        ("S05", 1, 2, 4.0 * part, 4.0)
    ] * len(said)


def test_s05_sums_the_last_quarter_of_a_second_since_the_first_cycle():
    period, rng = 2.0**-8, random.Random(0)
    rule = RULES["S05"](replace(Rig().gate.envelope, period=period))
    since: list[tuple[float, float]] = []
    now = 1.0
    for k in range(400):
        is_first = k in (0, 40, 170)
        now += period * rng.choice([1, 1, 1, 2, 5])  # multiples: some are a quarter second apart
        largest = rng.choice([0.1, 0.5, 1.0])
        since = [(now - period, 0.0)] if is_first else since
        since.append((now, largest))
        old = [t for t, _ in since if t <= now - 0.25]
        start = max(old) if old else since[0][0]
        way = sum(part for t, part in since[1:] if t > start) * period
        cycle = SimpleNamespace(now=now, is_first=is_first)
        expected = way / max(now - start, 0.25)
        assert rule._over_window(cycle, largest) == pytest.approx(expected, rel=1e-9)


def test_s08_lets_a_joint_go_exactly_twice_as_far_as_at_full_speed():
    rule = RULES["S08"](Rig().gate.envelope)
    cycle = one_arm(speed=[2.0, 0.0, 2.0000001], asked_step=[-3.0, 0.0, -7.0])
    assert rule.margin(cycle) < 0.0
    rule._limits = rule._limits[:1]
    (verdict,) = rule.judge(cycle)
    assert (verdict.joint, verdict.value, verdict.action) == (2, 7.0, Action.HOLD)


@pytest.mark.parametrize(("over", "holds"), [(0.0, 0), (0.5, 0), (2.0, 1)])
def test_s09_allows_a_first_command_a_roundings_width_more(over, holds):
    rig = Rig()
    rule, cycle = RULES["S09"](rig.gate.envelope), at({})
    assert cycle.is_first
    far = ARM.first_command[1] * (1.0 + over * ROUNDING)
    arm = rig.state().arms[0]
    jp = list(arm.setpoint_jp)
    jp[1] = 0.0
    cycle.state = replace(
        cycle.state, arms=(replace(arm, setpoint_jp=tuple(jp)), rig.state().arms[1])
    )
    moved = replace(rig.stay()[0], jp=(jp[0], far, *jp[2:]))
    cycle.tracks[0].ask(moved)
    assert len(words(rule, cycle)) == holds


def test_s09_holds_beyond_its_border_alone():
    rule = RULES["S09"](Rig().gate.envelope)
    rule._distances = lambda cycle: [(0, 1, 5.0, 5.0, 1.0), (0, 2, 6.0, 5.0, 1.2)]
    (verdict,) = rule.judge(None)
    assert (verdict.joint, verdict.value, verdict.limit) == (2, 6.0, 5.0)


def test_s10_lets_a_tip_be_exactly_as_fast_as_its_ceiling():
    rule = RULES["S10"](Rig().gate.envelope)
    rule._ceiling = 0.25 * (1.0 - ROUNDING)
    (verdict,) = rule.judge(one_arm(point_speed=0.25))
    assert verdict.action is Action.HOLD
    (verdict,) = rule.judge(one_arm(point_speed=0.2500001))
    assert (verdict.action, verdict.limit) == (Action.STOP, rule._ceiling)


@pytest.mark.parametrize(
    ("distance", "action"),
    [(1.0, None), (1.0001, Action.WARN), (2.0, Action.WARN), (2.0001, Action.STOP)],
)
def test_s12_warns_beyond_one_distance_and_stops_beyond_the_other(distance, action):
    rule = RULES["S12"](Rig().gate.envelope)
    rule._warn, rule._stop = (1.0,), (2.0,)
    points = ((0.0,) * 3, (0.0,) * 3, (distance, 0.0, 0.0), (distance, 0.0, 1.0))
    envelope = SimpleNamespace(port=(0.0, 0.0, 5.0), port_warn=1.0, port_stop=2.0)
    said = list(rule.judge(one_arm(fastest=0.5, asked_points=points, envelope=envelope)))
    assert [v.action for v in said] == [action] * (action is not None)


@pytest.mark.parametrize(("fastest", "gone"), [(100.0, 3.0), (100.0001, 0.0)])
def test_s12_measures_nothing_in_a_leap(fastest, gone):
    points = ((0.0,) * 3, (0.0,) * 3, (3.0, 0.0, 0.0), (3.0, 0.0, 1.0))
    envelope = SimpleNamespace(port=(0.0, 0.0, 5.0))
    (track,) = one_arm(fastest=fastest, asked_points=points, envelope=envelope).tracks
    assert s12_port._distance(track) == gone


@pytest.mark.parametrize(("gap", "leaves"), [(-1e-12, True), (0.0, False), (1e-12, False)])
def test_s11_is_left_below_a_gap_of_nothing(gap, leaves):
    rule, cycle = RULES["S11"](Rig().gate.envelope), at({0: 0.1}, {0: 1e-3})
    rule._gap = lambda arm, point, jaw_end: 1.0
    assert rule._is_leaving(cycle.tracks[0], gap) is leaves


def test_s11_measures_the_jaws_end_from_the_floor_wherever_that_is():
    rule = RULES["S11"](Rig().gate.envelope)
    rule._floor, rule._boxes = -0.02, (((-1.0,) * 3, (1.0,) * 3),)
    assert rule._gap(0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.01)) == pytest.approx(0.03, abs=2e-9)


@pytest.mark.parametrize("depth", [0.0, -1e-12])
def test_s13_asks_how_an_arm_moves_only_short_of_the_cannulas_end(depth):
    cycle = at({2: ARM.insertion_min + depth}, {0: 1e-3})
    rule = RULES["S13"](cycle.envelope)
    rule._least = tuple(track.asked_q[2] for track in cycle.tracks)  # exactly there
    assert rule.margin(cycle) == 0.0
    assert list(rule.judge(cycle)) == []
    rule._least = tuple(track.asked_q[2] + 1e-12 for track in cycle.tracks)
    assert rule.margin(cycle) == -1.0
    (verdict,) = rule.judge(cycle)  # the other arm stands
    assert (verdict.arm, verdict.joint) == (0, 2)


def test_s16_counts_to_three_and_from_the_start_again():
    rule = RULES["S16"](Rig().gate.envelope)

    def asked(setpoints, failure="", is_stopping=False):
        request = SimpleNamespace(setpoints=setpoints, failure=failure)
        margin = rule.margin(SimpleNamespace(request=request, is_stopping=is_stopping))
        said = [] if margin >= 0.0 else [v.action for v in rule.judge(None)]
        return margin, said

    held, fault = [Action.HOLD], [Action.FAULT]
    assert asked(None) == (-1.0, held)
    assert asked(None, "no solution") == (-2.0, held)
    assert asked(None, "no solution", True) == (-3.0, fault)
    assert asked(None, "", True) == (1.0, [])
    assert asked(None, "no solution", True) == (-1.0, held)
    assert asked(()) == (1.0, [])
    assert asked(None) == (-1.0, held)


def test_s17_measures_how_long_an_arm_is_off_to_the_border():
    rule = RULES["S17"](Rig().gate.envelope)
    rule._time, rule._off, rule._far_off = (1.0, 1.0), [0.0, 0.0], [0.0, 0.0]
    parts = [[1.0, 0.5], [0.25]]
    rule._parts = lambda cycle, index, arm: parts[index]
    cycle = SimpleNamespace(
        state=SimpleNamespace(arms=("one", "other")), dt=0.5, stopped_before=frozenset()
    )
    assert rule.margin(cycle) == 0.0  # at the tolerance: not off
    assert rule._off == [0.0, 0.0]
    parts[0] = [1.5, 2.0]
    assert rule.margin(cycle) == 0.0
    assert (rule._off, rule._far_off) == ([0.5, 0.0], [0.0, 0.0])
    assert rule.margin(cycle) == 0.0  # off for as long as it may be
    assert list(rule.judge(cycle)) == []
    parts[0] = [2.5, 1.0]
    assert rule.margin(cycle) == -0.5
    (verdict,) = rule.judge(cycle)
    assert (verdict.arm, verdict.joint, verdict.action) == (0, 0, Action.STOP)
    assert verdict.value == pytest.approx(2.5 * ARM.tracking[0])
    parts[0] = [0.5]
    rule.margin(cycle)
    assert (rule._off, rule._far_off) == ([1.375, 0.0], [0.375, 0.0])
    rule._off = [1.125, 0.0]
    assert rule.margin(cycle) == 0.5  # down to what it may be: the error counts again
    rule._off, parts[0] = [0.625, 0.0], [0.75]
    assert rule.margin(cycle) == 0.25
    for off, far_off, action in ((1.5, 1.0, Action.STOP), (1.5, 1.5, Action.FAULT)):
        rule._off, rule._far_off = [off, 1.0], [far_off, 0.0]
        (verdict,) = rule.judge(cycle)
        assert verdict.action is action
    cycle.stopped_before = frozenset({"S17"})
    rule._far_off = [0.0, 0.0]
    (verdict,) = rule.judge(cycle)
    assert verdict.action is Action.FAULT


def test_s18_tells_old_numbers_from_frozen_ones_at_the_border():
    rule = RULES["S18"](Rig().gate.envelope)
    rule._hold, rule._fault, rule._far = (0.25,), (0.5,), ((0.5,),)
    rule._freezes = rule._freezes[:1]

    def seen(now, stamp, q, measured=(0.0,)):
        arm = SimpleNamespace(stamp_s=stamp, measured_jp=measured)
        track = SimpleNamespace(index=0, q=(q,))
        cycle = SimpleNamespace(now=now, state=SimpleNamespace(arms=[arm]), tracks=[track])
        margin, verdicts = rule.margin(cycle), list(rule.judge(cycle))
        assert all((v.arm, v.joint) == (0, -1) for v in verdicts)
        return margin, [(v.action, v.value) for v in verdicts]

    assert seen(2.0, 2.0, 0.0) == (1.0, [])
    assert seen(2.25, 2.25, 9.0) == (1.0, [])  # frozen for as long as may be
    assert seen(2.5, 2.5, 0.5) == (1.0, [])  # and the setpoint has not moved farther than it may
    assert seen(2.5, 2.5, 0.75) == (-1.0, [(Action.HOLD, 0.5)])
    assert seen(2.5, 2.5, -0.75) == (-1.0, [(Action.HOLD, 0.5)])
    assert seen(2.75, 2.75, 0.75) == (-2.0, [(Action.FAULT, 0.75)])
    assert seen(2.75, 1.75, 0.75) == (-3.0, [(Action.FAULT, 1.0)])  # older still than frozen
    assert seen(3.0, 2.75, 9.0, (1.0,)) == (0.0, [])
    assert seen(3.0, 3.5, 9.0, (1.0,)) == (-1.0, [(Action.HOLD, 0.5)])


def test_s19_counts_from_when_the_waypoint_was_due():
    rule = RULES["S19"](Rig().gate.envelope)
    due = {inf: 1.0, 2.0: 1.0, 1.0: 1.0, 0.95: 0.5, 0.9: 0.0}
    for at_s, margin in due.items():
        cycle = SimpleNamespace(now=1.0, request=SimpleNamespace(waypoint_due_s=at_s))
        assert rule.margin(cycle) == pytest.approx(margin, abs=1e-7)
        assert rule.margin(cycle) >= 0.0


def test_s20_counts_overruns_of_a_second_and_knows_one_that_is_too_long():
    rule = RULES["S20"](Rig().gate.envelope)
    rule._limit = 0.03125

    def late(now, dt):
        cycle = SimpleNamespace(now=now, dt=dt)
        rule.margin(cycle)
        (verdict,) = rule.judge(cycle)
        return verdict.action

    for k in range(4):
        assert late(1.0 + k / 8, 0.03125) is Action.WARN  # as long as allowed: none
    assert late(2.0, 0.04) is late(2.5, 0.04) is Action.WARN
    assert late(3.0, 0.04) is Action.HOLD  # the first is exactly a second old
    assert late(3.5, 0.04) is Action.HOLD
    assert late(4.25, 0.04) is Action.WARN
    assert late(9.0, 0.05) is Action.HOLD
    assert late(11.0, 0.0499) is Action.WARN


def test_s20_and_s26_allow_a_roundings_width_more():
    envelope = Rig().gate.envelope
    overrun, watchdog = RULES["S20"](envelope), RULES["S26"](envelope)
    for over, kept in ((0.0, True), (0.5, True), (2.0, False)):
        cycle = SimpleNamespace(now=1.0, dt=3.0 * PERIOD + over * ROUNDING)
        assert (overrun.margin(cycle) >= 0.0) is kept
        inputs = SimpleNamespace(watchdog_stamp_s=1.0 - 0.05 - over * ROUNDING)
        cycle.state = SimpleNamespace(inputs=inputs)
        assert (watchdog.margin(cycle) >= 0.0) is kept


@pytest.mark.parametrize(
    ("given", "dt", "margin"),
    [(1.0, 0.0, 1.0), (1.0, 0.4999, 1.0), (1.0, 0.5, -1.0), (0.9999, 0.1, -1.0)],
)
def test_s21_lets_time_stand_but_not_leap(given, dt, margin):
    rule = RULES["S21"](Rig().gate.envelope)
    assert rule.margin(SimpleNamespace(given_now=given, now=1.0, dt=dt)) == margin


def test_s22_believes_a_word_to_the_border_of_its_age():
    rule = RULES["S22"](Rig().gate.envelope)
    rule._hold, rule._stop = 0.25, 2.0

    def said(now, stamp, consent=True, is_first=False):
        inputs = SimpleNamespace(
            consent=consent, consent_source="pedal", consent_stamp_s=stamp,
            consent_is_streamed=True,
        )  # fmt: skip
        cycle = SimpleNamespace(
            now=now, is_first=is_first, state=SimpleNamespace(inputs=inputs, arms=())
        )
        margin = rule.margin(cycle)
        verdicts = [] if margin >= 0.0 else list(rule.judge(cycle))
        return margin, [(v.action, v.value, v.limit) for v in verdicts]

    assert said(1.0, 1.0, False, is_first=True) == (-1.0, [(Action.STOP, inf, 2.0)])
    assert said(1.25, 1.0) == (0.0, [])  # good until here: the word is of 1.0
    assert said(1.375, 1.0) == (-0.5, [(Action.HOLD, 0.375, 0.25)])
    assert said(2.0, 1.0) == (-1.0, [(Action.HOLD, 1.0, 0.25)])
    assert said(3.0, 1.0) == (-1.0, [(Action.HOLD, 2.0, 0.25)])
    assert said(3.0, 3.0, False) == (-1.0, [(Action.HOLD, 2.0, 0.0)])
    assert said(3.125, 1.0) == (-1.0, [(Action.STOP, 2.125, 2.0)])


def test_what_is_one_thing_or_the_other_has_a_margin_of_one_or_minus_one():
    rig = Rig()
    good, cycle = at({}), at({})
    cycle.state = replace(cycle.state, inputs=replace(cycle.state.inputs, estop=True))
    cycle.state = replace(cycle.state, inputs=replace(cycle.state.inputs, watchdog_stepped_in=True))
    cycle.reports = ("?",)
    for rule_id in ("S23", "S25", "S32"):
        rule = RULES[rule_id](rig.gate.envelope)
        assert (rule.margin(good), rule.margin(cycle)) == (1.0, -1.0)
    for broken in ({"valid": False}, {"is_homed": False}, {"operating_state": "DISABLED"}):
        rig.broken = {1: broken}
        good.state = rig.state()
        assert RULES["S23"](rig.gate.envelope).margin(good) == -1.0


def test_s29_widens_the_range_of_training_by_a_twentieth_and_what_sensors_do():
    ranges = s29_training_range.widened(ObservationRange((0.0, 1.0), (2.0, 1.0)))
    assert [ranges.nearest(0, -9.0), ranges.nearest(0, 9.0)] == pytest.approx([-0.102, 2.102])
    assert [ranges.nearest(1, -9.0), ranges.nearest(1, 9.0)] == pytest.approx([0.998, 1.002])


def test_s29_holds_when_an_observation_has_been_outside_for_a_second():
    rule = RULES["S29"](Rig().gate.envelope)

    def seen(now, part):
        rule._farthest = lambda observation: part
        request = SimpleNamespace(observation=(float(now),))
        cycle = SimpleNamespace(now=now, request=request)
        margin = rule.margin(cycle)
        return margin, [v.action for v in rule.judge(cycle)] if margin < 0.0 else []

    assert seen(1.0, 1.0) == (0.0, [])  # at the border: inside
    assert seen(1.5, 1.5) == (-0.5, [Action.WARN])
    assert seen(2.25, 3.0) == (-2.0, [Action.WARN])
    assert seen(2.5 - 2.0 * ROUNDING, 1.5) == (-0.5, [Action.WARN])
    assert seen(2.5 - 0.5 * ROUNDING, 1.5) == (-0.5, [Action.HOLD])
    assert seen(2.75, 0.5) == (0.5, [])
    assert seen(3.0, 1.5) == (-0.5, [Action.WARN])
    assert seen(3.1, inf) == (-inf, [Action.HOLD])


def test_s29_counts_an_observation_that_is_hardly_outside_to_the_very_second():
    rule = RULES["S29"](Rig().gate.envelope)
    rule._farthest = lambda observation: 1.02
    now = 1.0 - 2.0 * ROUNDING
    while now + ROUNDING < 1.0:
        now = math.nextafter(now, inf)
    assert now + ROUNDING == 1.0
    for at_s, action in ((0.0, Action.WARN), (0.5, Action.WARN), (now, Action.HOLD)):
        cycle = SimpleNamespace(now=at_s, request=SimpleNamespace(observation=(at_s,)))
        assert rule.margin(cycle) == pytest.approx(-0.02)
        assert [v.action for v in rule.judge(cycle)] == [action]


def test_s29_is_content_without_an_observation_after_one():
    rule = RULES["S29"](Rig().gate.envelope)
    for observation, margin in (((9.0,), -inf), ((), 1.0)):
        cycle = SimpleNamespace(now=1.0, request=SimpleNamespace(observation=observation))
        assert rule.margin(cycle) == margin


def jaw_rule(**track: object) -> tuple:
    """S30 for one jaw that may be between 0.5 and 1.5 rad and move at 2 rad/s, and its cycle."""
    rule = RULES["S30"](Rig().gate.envelope)
    rule._range, rule._speed, rule._jaw = ((0.5, 1.5),), (2.0,), (6,)
    rule._grip = [inf]
    return rule, one_arm(**track)


@pytest.mark.parametrize(
    ("before", "jaw", "bound"),
    [
        (0.6, 0.5 - ROUNDING, None),
        (0.6, 0.5 - 1e-6, 0.5),
        (0.5 - 1e-6, 0.5 - 1e-6, None),
        (0.4, 0.45, None),
        (1.4, 1.5 + ROUNDING, None),
        (1.4, 1.5 + 1e-6, 1.5),
        (1.5 + 1e-6, 1.5 + 1e-6, None),
        (1.7, 1.6, None),
    ],
)
def test_s30_keeps_a_jaw_in_its_range_on_its_way_out_alone(before, jaw, bound):
    asked = SimpleNamespace(jaw=jaw, jaw_v=0.0)
    rule, cycle = jaw_rule(q=(before,), asked=asked, speed=[0.0])
    cycle.request = SimpleNamespace(holding=(False,), may_open_jaw=())
    assert (rule.margin(cycle) == -1.0) is (bound is not None)
    assert [(v.joint, v.value, v.limit) for v in rule.judge(cycle)] == [(6, jaw, bound)] * (
        bound is not None
    )


@pytest.mark.parametrize(
    ("speed", "along", "holds"),
    [
        (1.0, 0.0, 0),
        (1.0001, 0.0, 1),
        (0.0, -2.0 * (1.0 + 0.5 * ROUNDING), 0),
        (0.0, 2.0 * (1.0 + 2.0 * ROUNDING), 1),
    ],
)
def test_s30_takes_the_faster_of_what_a_jaw_does_and_says(speed, along, holds):
    asked = SimpleNamespace(jaw=1.0, jaw_v=along)
    rule, cycle = jaw_rule(q=(1.0,), asked=asked, speed=[9.0, speed])
    cycle.request = SimpleNamespace(holding=(False,), may_open_jaw=())
    assert (rule.margin(cycle) < 0.0) is bool(holds)
    assert len(list(rule.judge(cycle))) == holds


def test_s30_keeps_a_grip_to_the_border():
    asked = SimpleNamespace(jaw=0.75, jaw_v=0.0)
    rule, cycle = jaw_rule(q=(0.75,), asked=asked, speed=[0.0])
    cycle.request = SimpleNamespace(holding=(True,), may_open_jaw=())
    rule._opening = lambda cycle, arm: 0.02
    assert rule.margin(cycle) == 0.0
    assert list(rule.judge(cycle)) == []
    del rule._opening
    for over, holds in ((0.5, 0), (2.0, 1)):
        asked.jaw = 0.75 + 0.02 * (1.0 + over * ROUNDING)
        assert (rule.margin(cycle) < 0.0) is bool(holds)
        assert [v.value for v in rule.judge(cycle)] == [pytest.approx(0.02)] * holds


class Pair:
    """Two things whose distance is given."""

    radius, slow, stop, arms, pair = 0.25, 2.0, 1.0, (0, -1), "made_up"

    def __init__(self, *gaps: float) -> None:
        self.gaps = list(gaps)
        self.asked = 0

    def gap(self, ports: object, points: object) -> float:
        self.asked += 1
        return self.gaps.pop(0) if len(self.gaps) > 1 else self.gaps[0]


def s14_of(*pairs: Pair, to_rest: float = 0.5):
    """S14 with pairs that are made up, arms that stand, and a way to rest that is given."""
    rule = RULES["S14"](Rig().gate.envelope)
    rule._apart = tuple(pairs)
    rule._free, rule._due = [inf] * len(pairs), [-inf] * len(pairs)
    rule._reaches = [SimpleNamespace(travel=lambda track: to_rest)]
    points = ((0.0,) * 3,) * 4
    return rule, one_arm(
        fastest=0.0, asked_points=points, points=points, point=points[0], step=[0.0]
    )


@pytest.mark.parametrize(("free", "judged"), [(0.5, True), (0.5000001, False)])
def test_s14_judges_a_pair_that_a_stop_could_just_bring_near(free, judged, monkeypatch):
    pair = Pair(2.0 + free)
    rule, cycle = s14_of(pair)
    monkeypatch.setattr(s14_distance, "_ways", lambda tracks: [[], []])
    rule._look(cycle.tracks, 0.5)
    assert pair.asked == (4 if judged else 1)  # asked, two ways through a stop, and before


def test_s14_looks_again_when_what_was_free_may_be_used_up_and_no_sooner():
    pair = Pair(4.0)
    rule, cycle = s14_of(pair)
    cycle.is_first = False
    assert rule.margin(cycle) == 1.0
    assert pair.asked == 1
    look, looks = rule._look, []
    rule._look = lambda *args: looks.append(1) or look(*args)
    rule._travelled = lambda track: 0.75  # counts twice: 1.5 and the half of the way to rest
    rule.margin(cycle)
    assert (pair.asked, looks) == (1, [])  # 2.0 of 2.0: just not yet
    rule._travelled = lambda track: 1e-9
    rule.margin(cycle)
    assert (pair.asked, looks) == (2, [1])


def test_s14_looks_at_a_pair_only_when_that_is_due_itself():
    near, far = Pair(3.0), Pair(9.0)
    rule, cycle = s14_of(near, far)
    rule._look(cycle.tracks, 0.5)
    assert (rule._due, rule._next) == ([1.0, 7.0], 1.0)
    rule._used = 0.5
    rule._look(cycle.tracks, 0.5)
    assert (near.asked, far.asked) == (1, 1)  # at the border: not yet
    rule._used = 0.6
    rule._look(cycle.tracks, 0.5)
    assert (near.asked, far.asked) == (2, 1)


def test_s14_works_the_ways_through_a_stop_out_once_for_all_pairs(monkeypatch):
    rule, cycle = s14_of(Pair(1.5), Pair(1.6), Pair(1.7))
    asked = []
    monkeypatch.setattr(s14_distance, "_ways", lambda tracks: asked.append(1) or [[], []])
    rule._look(cycle.tracks, 0.5)
    assert len(asked) == 1


@pytest.mark.parametrize(("fastest", "looks"), [(100.0, 1), (100.0001, 0)])
def test_s14_does_not_look_where_a_leap_leads(fastest, looks):
    pair = Pair(4.0)
    rule, cycle = s14_of(pair)
    cycle.is_first, cycle.tracks[0].fastest = True, fastest
    assert rule.margin(cycle) == 1.0
    assert pair.asked == looks


@pytest.mark.parametrize(
    ("before", "left", "action"),
    [
        (5.0, 2.0 * (1.0 - ROUNDING), None),
        (5.0, 2.0 * (1.0 - 2.0 * ROUNDING), Action.SCALE),
        (1.5, 1.5, None),
        (5.0, 1.0 * (1.0 - ROUNDING), Action.SCALE),
        (5.0, 1.0 * (1.0 - 2.0 * ROUNDING), Action.STOP),
        (0.5, 0.5, None),
        (ROUNDING - 0.25, ROUNDING - 0.25, Action.STOP),
        (-0.25 + 2.0 * ROUNDING, -0.25 + 2.0 * ROUNDING, None),
    ],
)
def test_s14_judges_what_is_left_to_the_border(before, left, action):
    rule, cycle = s14_of()
    rule._judge(Pair(before), cycle.tracks, left)
    assert [v.action for v in rule._verdicts] == [action] * (action is not None)
    for verdict in rule._verdicts:
        assert verdict.value == before - left
        assert verdict.limit == before - (1.0 if action is Action.STOP else 2.0)


def test_s14_follows_the_jaws_end_where_something_must_keep_clear_of_it():
    points = ((0.0,) * 3,) * 4
    asked = (points[0], (0.0, 0.0, 0.5), (0.25, 0.0, 0.0), points[0])
    (track,) = one_arm(asked_points=asked, points=points, point=points[0]).tracks
    rule = RULES["S14"](Rig().gate.envelope)
    assert not rule._has_jaw
    assert rule._travelled(track) == 0.25
    box = KeepOut(name="lamp", lower_m=(0.1, 0.1, 0.1), upper_m=(0.2, 0.2, 0.2))
    wide = Clearance(slow_m=0.004, stop_m=0.002)
    given = CELL.file.distances
    apart = given.apart | {f"{part}_keep_out": wide for part in ("shaft", "wrist", "jaw")}
    distances = given.model_copy(update={"apart": apart, "keep_out": (box,)})
    cell = replace(CELL, file=CELL.file.model_copy(update={"distances": distances}))
    rule = RULES["S14"](CellEnvelope.of(cell, PERIOD))
    assert rule._has_jaw
    assert rule._travelled(track) == 0.5


def s15_of(values: dict[float, float], monkeypatch):
    """S15 for arms whose smallest singular value is given by their first joint."""
    asked = []

    def value_of(arm: object, q: tuple[float, ...]) -> float:
        asked.append(q[0])
        return values[q[0]]

    monkeypatch.setattr(s15_conditioning, "smallest_singular_value", value_of)
    rule = RULES["S15"](Rig().gate.envelope)
    rule._changes = [(0.5,), (0.5,)]
    return rule, asked


def conditioned(*joints: tuple[float, float]) -> SimpleNamespace:
    """Arms that go from a joint to another, and slow below 1.0 and hold below 0.5."""
    envelope = SimpleNamespace(slow_value=1.0, least_value=0.5, ik_residual=0.001)
    tracks = [
        SimpleNamespace(index=i, envelope=envelope, q=(a,), asked_q=(b,), asked_point=(0.0,) * 3)
        for i, (a, b) in enumerate(joints)
    ]
    return SimpleNamespace(tracks=tracks, request=SimpleNamespace(tips=()))


@pytest.mark.parametrize(
    ("value", "action"),
    [
        (1.0 - ROUNDING, None),
        (1.0 - 2.0 * ROUNDING, Action.SCALE),
        (0.5 * (1.0 - ROUNDING), Action.SCALE),
        (0.5 * (1.0 - 2.0 * ROUNDING), Action.HOLD),
    ],
)
def test_s15_slows_and_holds_under_its_bounds(value, action, monkeypatch):
    rule, _ = s15_of({0.0: 3.0, 1.0: value, 2.0: 3.0}, monkeypatch)
    cycle = conditioned((0.0, 1.0), (0.0, 2.0))
    assert rule.margin(cycle) == (0.0 if action is None else -1.0)
    said = list(rule.judge(cycle))
    assert [(v.arm, v.action) for v in said] == [(0, action)] * (action is not None)


def test_s15_blames_no_arm_that_goes_away_from_a_singularity(monkeypatch):
    rule, _ = s15_of({0.0: 0.25, 1.0: 0.75, 2.0: 3.0, 3.0: 0.125}, monkeypatch)
    cycle = conditioned((0.0, 1.0), (2.0, 3.0))
    assert rule.margin(cycle) == -1.0
    (verdict,) = rule.judge(cycle)
    assert (verdict.arm, verdict.joint, verdict.value, verdict.limit) == (1, -1, 8.0, 2.0)
    rule, _ = s15_of({0.0: 0.25, 1.0: 0.75}, monkeypatch)
    assert rule.margin(conditioned((0.0, 1.0))) == 0.0


@pytest.mark.parametrize(("less", "approaches"), [(1e-9, False), (1.001e-9, True)])
def test_s15_takes_a_nanometre_for_rounding(less, approaches, monkeypatch):
    rule, _ = s15_of({0.0: 0.25, 1.0: 0.25 - less}, monkeypatch)
    (track,) = conditioned((0.0, 1.0)).tracks
    assert rule._is_approaching(track) is approaches


def test_s15_works_the_value_out_anew_when_half_of_what_was_free_may_be_gone(monkeypatch):
    rule, asked = s15_of({4.0: 3.0, 6.0: 2.5, 6.5: 2.25}, monkeypatch)

    def at_least(q: float) -> float:
        (track,) = conditioned((0.0, q)).tracks
        return rule._at_least(track)

    assert at_least(4.0) == 3.0
    assert (at_least(6.0), asked) == (2.0, [4.0])  # 2 rad at 0.5: half of 2.0 is just not gone
    assert (at_least(6.5), asked) == (2.25, [4.0, 6.5])


def test_s15_holds_a_tip_off_its_path_beyond_the_border_alone(monkeypatch):
    rule, _ = s15_of({0.0: 3.0, 1.0: 3.0}, monkeypatch)
    cycle, parts = conditioned((0.0, 1.0), (0.0, 1.0)), [1.0, 1.5]
    monkeypatch.setattr(s15_conditioning, "_residual", lambda cycle, track: parts[track.index])
    assert rule.margin(cycle) == -0.5
    (verdict,) = rule.judge(cycle)
    assert (verdict.arm, verdict.joint, verdict.action) == (1, -1, Action.HOLD)
    assert (verdict.value, verdict.limit) == (0.0015, 0.001)


def common_stop(v: float, a: float) -> CommonStop:
    """The stop of a 7-joint arm of which the first joint alone moves."""
    (arm,) = CellEnvelope.of(load_cell("bodytrainer"), PERIOD).arms
    motions = [(0.0, v, a), *[(0.0, 0.0, 0.0)] * 7]
    return CommonStop(motions, arm.max_acceleration, arm.max_jerk)


@pytest.mark.parametrize(
    ("v", "a"),
    [
        (0.0018788825840989308, -0.13548941937970232),  # would take 2.01 times as long
        (-0.034517244923488906, 4.929252633022206),  # would go back by 19 times the way
    ],
)
def test_a_clock_that_would_take_or_go_too_long_starts_evenly(v, a):
    assert common_stop(v, a)._clock.phases[0][3] == 0.0


@pytest.mark.parametrize(
    ("phases", "extent"),
    [
        ([(0.0, 0.0, 1.0, 0.0, -4.0), (1.0, 0.0, 0.5, -2.0, 0.0)], (0.0, 3.0)),
        ([(0.0, 0.0, -1.0, 2.0, 4.0)], (-3.0, 1.0)),
    ],
)
@pytest.mark.parametrize(("v", "c"), [(0.5, 0.25), (-0.5, -0.25), (0.5, -0.25)])
@pytest.mark.parametrize(("over", "smooth"), [(0.0, True), (1e-9, False)])
def test_a_joint_is_smooth_under_a_clock_up_to_its_jerk(phases, extent, v, c, over, smooth):
    clock = SimpleNamespace(phases=phases, extent=lambda: extent)
    jerk = (0.5 + 0.25 * 3.0) * 4.0 + 3.0 * 0.25 * 1.0 * 2.0  # (|v| + |c| s) s''' + 3 |c| s' s''
    assert stopping._is_smooth(clock, [(0.0, v, c)], (jerk - over,)) is smooth


def test_the_arms_are_at_rest_when_the_last_sample_of_the_stop_was_sent():
    rig = Rig.running()
    assert not rig.gate._is_at_rest
    rig.ask(None)
    rig.gate._stops = [SimpleNamespace(duration_s=3 * PERIOD, at=s.at) for s in rig.gate._stops]
    assert rig.gate._stop_cycles == 1
    assert [rig.ask(rig.stay()).at_rest for _ in range(3)] == [False, True, True]


def test_a_gate_that_was_not_armed_has_nothing_at_rest():
    rig = Rig()
    gate = rig.gate
    gate._cycle.is_stopping, gate._stops, gate._stop_cycles = True, [], 5
    assert not gate._is_at_rest
    gate._is_armed = True
    assert gate._is_at_rest
    gate._cycle.is_stopping = False
    assert not gate._is_at_rest


def test_before_arming_the_gate_refuses_with_s09_and_full_margins():
    rig = Rig()
    decision = rig.ask(rig.stay())
    assert decision.setpoints == ()
    assert decision.verdicts == (Verdict("S09", Action.HOLD),)
    assert (decision.speed_scale, decision.passed, decision.at_rest) == (1.0, False, False)
    assert set(decision.margins) == {1.0}


def test_a_report_before_arming_is_told_once():
    rig = Rig()
    rig.gate.report_fault("S24", rig.now)
    told = [[v.rule for v in rig.ask(rig.stay()).verdicts] for _ in range(2)]
    assert told == [["S24", "S09"], ["S09"]]


def test_a_reset_forgets_what_was_reported_before_it():
    rig = Rig.running()
    rig.ask(None)
    rig.rest()
    rig.gate.report_fault("S24", rig.now)
    rig.gate.reset(rig.now)
    assert rig.arm() == ()
    assert not rig.gate._cycle.is_stopping
    assert rig.ask(rig.stay()).passed


def test_a_reset_alone_ends_the_stop():
    rig = Rig.running()
    rig.ask(None)
    rig.rest()
    assert rig.gate.latched is Action.HOLD
    assert rig.gate.reset(rig.now) is Mode.CONNECTED
    assert not rig.gate._cycle.is_stopping
    assert rig.gate.latched is Action.PASS


@pytest.mark.parametrize(("step", "mode"), [(1e-6, Mode.CONNECTED), (1.1e-6, Mode.RUNNING)])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_arms_that_hardly_move_are_disarmed(step, mode, sign):
    rig = Rig.running()
    rig.gate._cycle.tracks[1].step[3] = sign * step
    assert rig.gate.disarm() is mode


def test_a_gate_is_disarmed_only_when_it_is_armed_and_does_not_stop():
    rig = Rig.running()
    rig.gate._cycle.is_stopping = True
    assert rig.gate.disarm() is Mode.RUNNING
    rig.gate._cycle.is_stopping, rig.gate._is_armed = False, False
    assert rig.gate.disarm() is Mode.RUNNING


@pytest.mark.parametrize("rule_id", ["S01", "S02", "S23"])
def test_a_margin_of_nothing_is_kept(rule_id):
    rig = Rig.running()
    rule = next(rule for rule in rig.gate._instances if rule.id == rule_id)
    margins = {rule.id: 1.0 for rule in rig.gate._instances}
    rule.margin = lambda cycle: 0.0
    decision = rig.ask(rig.stay())
    assert decision.passed
    margins.update(zip(rig.gate.rules, decision.margins, strict=True))
    assert margins[rule_id] == 0.0
    assert margins["S03"] < 1.0  # all that needs it was asked
    assert rig.gate._is_kept(rule_id)


@pytest.mark.parametrize(("jerk", "rough"), [(1.0, False), (1.0001, True)])
def test_a_stop_that_is_rougher_than_allowed_is_a_fault(jerk, rough, monkeypatch):
    rig = Rig.running()
    ask = ArmTrack.ask

    def asked(track: ArmTrack, setpoint: JointSetpoint) -> None:
        ask(track, setpoint)
        track.jerkiest = jerk if track.index == 1 else 0.0

    monkeypatch.setattr(ArmTrack, "ask", asked)
    decision = rig.ask(None)
    faults = [v for v in decision.verdicts if v.rule == "S07"]
    assert decision.action is (Action.FAULT if rough else Action.HOLD)
    assert faults == [Verdict("S07", Action.FAULT, 1, -1, jerk, 1.0)] * rough


@pytest.mark.parametrize(("early", "cleared"), [(0.0, True), (1e-6, False)])
def test_an_operator_may_clear_a_hold_exactly_when_the_clean_while_is_over(early, cleared):
    rig = Rig.running()
    rig.ask(None)
    rig.rest()
    gate = rig.gate
    gate._cycle.now, gate._dirty_at = 0.0, ROUNDING - CLEAN_S + early
    while early == 0.0 and -gate._dirty_at + ROUNDING > CLEAN_S:
        gate._dirty_at = math.nextafter(gate._dirty_at, inf)
    assert early or -gate._dirty_at + ROUNDING == CLEAN_S
    assert (gate.resume(rig.state(), 0.0) == ()) is cleared


def test_consent_that_is_withdrawn_as_the_operator_resumes_is_remembered():
    rig = Rig.running()
    rig.ask(None)
    rig.rest()
    rig.consent = False
    assert rig.gate.resume(rig.state(), rig.now) != ()
    assert rig.gate._saw_no_consent


def test_what_a_rule_warns_of_does_not_keep_a_cell_from_arming_nor_end_a_run(monkeypatch):
    rig = Rig()
    rule = RULES["S29"]
    monkeypatch.setattr(rule, "margin", lambda self, cycle: -1.0)
    monkeypatch.setattr(rule, "judge", lambda self, cycle: iter([Verdict("S29", Action.WARN)]))
    assert rig.arm() == ()
    assert rig.ask(rig.stay()).passed
    rig.ask(None)
    assert rig.gate._stopped_by == set()


def test_a_busy_arm_that_is_not_homed_is_no_readier():
    rig = Rig()
    rig.broken[0] = {"is_homed": False}
    assert rig.gate.connect(rig.state()) is Mode.CONNECTED
    rig.broken[0] = {"is_busy": True}
    assert rig.gate.connect(rig.state()) is Mode.HOMED
    for measured in ((math.nan,) * 6, None):
        rig.broken[0] = {"measured_jp": measured}
        assert rig.gate.connect(rig.state()) is Mode.CONNECTED
    for arms in (None, (), (None, None)):
        assert rig.gate.connect(replace(rig.state(), arms=arms)) is Mode.CONNECTED


def test_an_emergency_stop_waits_for_the_cycle_where_the_arms_are_armed():
    rig = Rig.running()
    rig.estop = True
    rig.gate._watch_people(rig.state())
    assert rig.gate.latched is Action.PASS
    assert rig.ask(rig.stay()).action is Action.ESTOP


def test_s24_blames_a_joint_beyond_the_border_alone_and_looks_no_farther_than_close():
    rig = Rig()
    cycle = at({})
    rule = RULES["S24"](rig.gate.envelope)
    parts = [1.0, 1.5]
    rule._nearest = lambda cycle, arm, track: parts[track.index]
    (verdict,) = rule.judge(cycle)
    assert verdict == Verdict("S24", Action.FAULT, 1, -1, 1.5, 1.0)


def test_a_request_without_setpoints_stops_the_arms_even_if_no_rule_minds(monkeypatch):
    rig = Rig.running()
    monkeypatch.setattr(RULES["S16"], "margin", lambda self, cycle: 1.0)
    decision = rig.ask(None)
    assert (decision.action, decision.passed) == (Action.HOLD, False)


def test_a_cell_is_not_armed_on_consent_that_is_only_not_denied():
    rig = Rig()
    rig.gate.connect(rig.state())
    rig.said = {"consent": None}
    assert rig.gate.arm(rig.state(), rig.now) == (Verdict("S22", Action.HOLD),)


def test_arming_asks_whether_the_arms_may_stand_where_they_are():
    rig = Rig()
    assert rig.arm() == ()
    for track, held in zip(rig.gate._cycle.tracks, rig.stay(), strict=True):
        assert track.asked == track.sent == held


def test_a_track_keeps_what_its_driver_may_still_report_and_no_more():
    (first, *_) = Rig().gate._cycle.tracks
    assert first.latency == 0.02
    assert first.recent.maxlen == 31  # 120 ms at 250 Hz, and the one that is held now


def test_a_track_that_begins_anew_has_sent_nothing_before():
    (first, *_), setpoint = Rig().gate._cycle.tracks, Rig().stay()[0]
    for jaw in (0.1, 0.2, 0.3):
        first.begin(replace(setpoint, jaw=jaw))
    assert [sent.jaw for sent in first.recent] == [0.3]


@pytest.mark.parametrize(("jaw", "joints"), [(0.002, 0.0), (0.0, s24_driver.CLOSE)])
def test_s24_looks_no_farther_back_than_a_setpoint_that_is_close(monkeypatch, jaw, joints):
    cycle, rule = at({}), RULES["S24"](Rig().gate.envelope)
    track, arm = cycle.tracks[0], replace(cycle.state.arms[0], jaw_setpoint_jp=jaw)
    newest, older = (replace(track.sent, jaw=x) for x in (0.0, 0.002))
    track.recent.clear()
    track.recent.extend([older, newest])
    assert 0.002 / s24_driver.JAW_TOLERANCE == s24_driver.CLOSE
    far = {0.0: joints, 0.002: 0.0}
    monkeypatch.setattr(s24_driver, "_distance", lambda arm, sent, by: far[sent.jaw])
    assert rule._nearest(cycle, arm, track) == s24_driver.CLOSE
    far[0.0] = 1.0
    arm = replace(arm, jaw_setpoint_jp=1.0)
    assert rule._nearest(cycle, arm, track) == pytest.approx(0.998 / s24_driver.JAW_TOLERANCE)


def test_a_reach_looks_at_every_joint_for_the_sharpest():
    (arm,) = CellEnvelope.of(load_cell("bodytrainer"), PERIOD).arms
    reach, ways = Reach(arm, PERIOD), []
    for joint in range(8):
        sharp = [0.5 * (j == joint) for j in range(8)]
        track = SimpleNamespace(acceleration=sharp, speed=[0.0] * 8, fastest=0.0)
        ways.append(reach.travel(track))
    assert min(ways[:7]) == max(ways[:7]) > ways[7] == 0.0


def test_a_clock_may_take_exactly_as_long_as_it_may(monkeypatch):
    v, a = 0.0018788825840989308, -0.13548941937970232
    monkeypatch.setattr(stopping, "LONGER", inf)
    clock = common_stop(v, a)._clock
    assert clock.phases[0][3] != 0.0
    monkeypatch.setattr(stopping, "LONGER", 0.0)
    flat = common_stop(v, a)._clock
    longer = max(clock.duration_s / flat.duration_s, max(map(abs, clock.extent())) / flat.end)
    monkeypatch.setattr(stopping, "LONGER", longer)
    assert common_stop(v, a)._clock.phases == clock.phases
    monkeypatch.setattr(stopping, "LONGER", math.nextafter(longer, 0.0))
    assert common_stop(v, a)._clock.phases == flat.phases


def test_an_operator_may_not_clear_a_hold_before_the_arms_rest():
    rig = Rig.running()
    rig.ask(None)
    rig.gate._stops = [SimpleNamespace(duration_s=5.0, at=stop.at) for stop in rig.gate._stops]
    for _ in range(round(2.0 * CLEAN_S / PERIOD)):
        rig.ask(rig.stay())
    assert rig.gate._cycle.now - rig.gate._dirty_at > CLEAN_S
    assert rig.gate.resume(rig.state(), rig.now) != ()
