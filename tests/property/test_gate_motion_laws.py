"""More laws of the gate: time, symmetry, stops, thresholds. `test_gate_laws.py` has the first."""

import math
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from gate_rig import CELL, PERIOD, RULES, Rig, asking, words, worst
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from viskill_deploy.core.errors import DataFileError
from viskill_deploy.core.types import Action, JointSetpoint, Mode, Request
from viskill_deploy.safety import ceilings
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.rehearsal import Rehearsal
from viskill_deploy.safety.supervisor import CLEAN_S, Supervisor

FEW = settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow], deadline=None)
TOPS = {0: 0.12, 1: 0.12, 2: 0.04, 3: 2.0, 4: 0.8, 5: 0.8}
"""Speed of each joint that keeps the tip under 50 mm/s, rad/s or m/s."""
SWINGS = st.tuples(st.sampled_from(sorted(TOPS)), st.floats(0.05, 1.0), st.integers(1, 40))
TROUBLES = st.sampled_from(["miss", "jump", "nan", "report", "stale", "foreign", "power"])
ALL_ACTIONS = st.sampled_from(["stay", "go on", "jump", "miss", "nan", "step"])


def moving(swing: tuple[int, float, int]) -> Rig:
    """A running cell whose first arm moves one joint."""
    joint, part, cycles = swing
    rig = Rig.running()
    for speed in islice(rig.speeds(joint, part * TOPS[joint]), cycles):
        assert rig.ask(rig.moved(0, joint, -speed * PERIOD)).passed
    return rig


def asked_for(rig: Rig, kind: str, arm: int = 1) -> tuple[JointSetpoint, ...] | None:
    """What a line may ask for: good, bad or nothing."""
    if kind == "miss":
        return None
    setpoints = list(rig.stay() if kind == "stay" else rig.going_on())
    if kind == "jump":
        return rig.moved(arm, 3, 0.5)
    if kind == "step":
        return rig.moved(arm, 3, 1e-5)
    if kind == "nan":
        setpoints[arm] = replace(setpoints[arm], jaw=math.nan)
    return tuple(setpoints)


def strike(rig: Rig, trouble: str, arm: int):
    """One cycle in which something goes wrong with one arm."""
    broken = {
        "stale": {"stamp_s": rig.now - 1.0},
        "foreign": {"setpoint_jp": tuple(q + 0.1 for q in rig.held[arm].jp)},
        "power": {"operating_state": "DISABLED"},
    }
    if trouble == "report":
        rig.gate.report_fault("S24", rig.now)
    rig.broken = {arm: broken[trouble]} if trouble in broken else {}
    kind = trouble if trouble in ("miss", "jump", "nan") else "go on"
    decision = rig.ask(asked_for(rig, kind, arm))
    rig.broken = {}
    return decision


def told(decision) -> tuple:
    """All that a decision says, comparable."""
    sent = tuple(checked.setpoint for checked in decision.setpoints)
    said = tuple(map(repr, decision.verdicts))
    return sent, decision.action, said, decision.mode, decision.speed_scale, decision.margins


@FEW
@given(SWINGS, st.lists(ALL_ACTIONS, min_size=1, max_size=8))
def test_the_same_inputs_get_the_same_answers(swing, kinds):
    one, other = moving(swing), moving(swing)
    for kind in kinds:
        assert told(one.ask(asked_for(one, kind))) == told(other.ask(asked_for(other, kind)))


@FEW
@given(SWINGS, st.lists(ALL_ACTIONS, min_size=1, max_size=8), st.integers(1, 20))
def test_it_does_not_matter_when_the_clock_began(swing, kinds, power):
    outcomes = []
    for origin in (1.0, 1.0 + 2.0**power):
        rig = Rig()
        rig.now = origin
        assert rig.arm() == ()
        rig.run()
        joint, part, cycles = swing
        for speed in islice(rig.speeds(joint, part * TOPS[joint]), cycles):
            assert rig.ask(rig.moved(0, joint, -speed * PERIOD)).passed
        outcomes.append([told(rig.ask(asked_for(rig, kind)))[:2] for kind in kinds])
    assert outcomes[0] == outcomes[1]


@FEW
@given(SWINGS, TROUBLES, st.sampled_from([0, 1]))
def test_trouble_with_one_arm_stops_both_in_the_same_cycle(swing, trouble, arm):
    rig = moving(swing)
    asked = rig.going_on()
    decision = strike(rig, trouble, arm)
    assert not decision.passed
    assert not any(a is c.setpoint for a in asked for c in decision.setpoints)
    rig.rest()
    rig.ask(None)
    for before, after in zip(rig.before, rig.held, strict=True):
        assert before.jp == after.jp
        assert after.jv == (0.0,) * 6


@FEW
@given(SWINGS, TROUBLES)
def test_the_two_arms_are_treated_alike(swing, trouble):
    first, second = (strike(moving(swing), trouble, arm) for arm in (0, 1))
    assert first.action is second.action
    assert {v.rule for v in first.verdicts} >= {v.rule for v in second.verdicts} - {"S07"}


@FEW
@given(SWINGS, TROUBLES, st.lists(ALL_ACTIONS, min_size=1, max_size=12))
def test_at_rest_after_a_stop_nothing_moves_whatever_is_asked(swing, trouble, kinds):
    rig = moving(swing)
    strike(rig, trouble, 0)
    rig.rest()
    held = rig.held
    for kind in kinds:
        decision = rig.ask(asked_for(rig, kind))
        assert decision.at_rest
        assert rig.held == held


@pytest.mark.invariant("S34", "S07")
@FEW
@given(SWINGS, TROUBLES)
def test_any_motion_that_passed_stops_in_a_third_of_a_second_inside_every_limit(swing, trouble):
    rig = moving(swing)
    trail = [rig.older, rig.before, rig.held]
    decision = strike(rig, trouble, 0)
    trail.append(rig.held)
    while not decision.at_rest:
        decision = rig.ask(None)
        trail.append(rig.held)
        assert len(trail) * PERIOD < 0.35
    for index, arm in enumerate(rig.gate.envelope.arms):
        q = np.array([(*row[index].jp, row[index].jaw) for row in trail])
        rows = (np.diff(q, n=n, axis=0) / PERIOD**n for n in (1, 2, 3))
        limits = (arm.max_speed, arm.max_acceleration, arm.max_jerk)
        for rates, limit in zip(rows, limits, strict=True):
            assert (abs(rates) <= np.array(limit) * (1.0 + 1e-6)).all()


@FEW
@given(SWINGS, st.lists(ALL_ACTIONS, min_size=1, max_size=6))
def test_margins_and_verdicts_tell_the_same(swing, kinds):
    rig = moving(swing)
    for kind in kinds:
        decision = rig.ask(asked_for(rig, kind))
        spoken = {v.rule for v in decision.verdicts}
        broken = {
            rule
            for rule, margin in zip(rig.gate.rules, decision.margins, strict=True)
            if not margin >= 0.0
        }
        assert spoken == broken
        assert max(decision.margins) <= 1.0
        assert decision.passed == (decision.action < Action.HOLD)


@FEW
@given(st.sampled_from(range(6)), st.floats(1.00001, 1.2), st.sampled_from(["S05", "S06", "S07"]))
def test_a_motion_slowed_as_asked_is_inside_the_limit(joint, factor, rule_id):
    """A time base that runs at the scale asked for has its n-th derivative scaled to the n."""
    arm = Rig().gate.envelope.arms[0]
    order = {"S05": 1, "S06": 2, "S07": 3}[rule_id]
    limit = (arm.max_speed, arm.max_acceleration, arm.max_jerk)[order - 1][joint]
    change = factor * limit * PERIOD**order
    steps = {1: (change, change, 0.0), 2: (change, 0.0, change), 3: (change, 0.0, 0.0)}[order]
    cycle, envelope = asking(0, joint, 0.1, *steps)
    verdicts = words(RULES[rule_id](envelope), cycle)
    assert worst(verdicts) is Action.SCALE
    (scale,) = {v.limit / v.value * (1.0 - 1e-9) for v in verdicts}
    assert scale < 1.0
    slowed, _ = asking(0, joint, 0.1, *(scale**order * step for step in steps))
    assert worst(words(RULES[rule_id](envelope), slowed)) is Action.PASS


@FEW
@given(
    st.sampled_from([0, 1]),
    st.tuples(*[st.floats(-1.0, 1.0)] * 7),
    st.floats(0.0, 1.0),
    st.floats(1e-8, 1e-2),
)
def test_from_rest_a_smaller_step_is_never_held_or_slowed_where_a_larger_one_is_not(
    arm, direction, part, size
):
    """Beyond HOLD there is no order: distances (S14) leave a leap to the rule on leaps (S08)."""
    outcomes = []
    for factor in (part * size, size):
        rig = Rig.running()
        held = rig.held[arm]
        units = rig.gate.envelope.arms[arm].max_speed
        steps = [factor * d * unit for d, unit in zip(direction, units, strict=True)]
        jp = tuple(q + step for q, step in zip(held.jp, steps, strict=False))
        moved = JointSetpoint(jp, held.jv, held.jaw + steps[6], 0.0)
        setpoints = tuple(moved if i == arm else s for i, s in enumerate(rig.stay()))
        free = {"holding": (False, False), "may_open_jaw": (True, True)}
        outcomes.append(min(rig.ask(setpoints, **free).action, Action.HOLD))
    assert outcomes[0] <= outcomes[1]


@FEW
@given(st.sampled_from([0, 1]), st.sampled_from(range(6)), st.floats(1e-9, 1.0))
def test_both_directions_of_a_joint_are_judged_alike(arm, joint, step):
    for rule_id in ("S05", "S06", "S07", "S08"):
        verdicts = [
            words(RULES[rule_id](envelope), cycle)
            for cycle, envelope in (asking(arm, joint, 0.1, side * step) for side in (-1.0, 1.0))
        ]
        one, other = [[(v.action, v.joint, v.limit) for v in side] for side in verdicts]
        assert one == other


@FEW
@given(
    st.sampled_from([0, 1]),
    st.sampled_from(["measured_jp", "measured_jv", "setpoint_jp", "jaw_measured_jp", "stamp_s"]),
    st.integers(0, 5),
    st.sampled_from([math.nan, math.inf, -math.inf, None, "1", 1]),
)
def test_one_bad_measurement_is_a_fault_in_that_very_cycle(arm, field, index, value):
    rig = Rig.running()
    old = getattr(rig.state().arms[arm], field)
    if isinstance(old, tuple):
        value = tuple(value if i == index else x for i, x in enumerate(old))
    rig.broken = {arm: {field: value}}
    decision = rig.ask(rig.stay())
    assert decision.action is Action.FAULT
    assert "S02" in {v.rule for v in decision.verdicts}
    assert not decision.passed


@FEW
@given(SWINGS, st.text(max_size=4), st.integers(1, 3))
def test_whatever_is_reported_stops_the_run_at_the_next_check_and_stays_latched(swing, rule, times):
    rig = moving(swing)
    for _ in range(times):
        rig.gate.report_fault(rule, rig.now)
    decision = rig.ask(rig.going_on())
    assert decision.action is (Action.STOP if rule == "S32" else Action.FAULT)
    assert len(decision.verdicts) == times
    rig.rest()
    assert rig.ask(rig.stay()).action is decision.action
    assert rig.gate.resume(rig.state(), rig.now) != ()


def thresholds() -> list[tuple[str, int, str]]:
    """(table, joint or -1, key) of every number of an arm that the gate reads."""
    arm = CELL.arms[0].arm
    found = [
        ("joint", index, key)
        for index, joint in enumerate(arm.joints)
        for key in type(joint).model_fields
        if key.startswith(("lower_", "upper_", "max_"))
    ]
    found += [("jaw", -1, key) for key in type(arm.jaw).model_fields if key != "effort_nm"]
    return found + [("gate", -1, key) for key in type(arm.gate).model_fields]


@pytest.mark.invariant("S31")
@settings(max_examples=200, deadline=None)
@given(
    st.sampled_from(thresholds()),
    st.one_of(
        st.floats(-10.0, 10.0).map(lambda x: ("times", x)),
        st.floats().map(lambda x: ("is", x)),
    ),
)
def test_no_number_in_a_file_makes_the_gate_looser_than_its_ceilings(place, change):
    (table, index, key), (how, number) = place, change
    first = CELL.arms[0]
    part = first.arm.joints[index] if table == "joint" else getattr(first.arm, table)
    old = getattr(part, key)
    new = part.model_copy(update={key: old * number if how == "times" else number})
    if table == "joint":
        joints = tuple(new if i == index else x for i, x in enumerate(first.arm.joints))
        arm = replace(first.arm, joints=joints)
    else:
        arm = replace(first.arm, **{table: new})
    cell = replace(CELL, arms=(replace(first, arm=arm), *CELL.arms[1:]))
    try:
        envelope = CellEnvelope.of(cell, PERIOD).arms[0]
    except DataFileError as error:
        assert error.key
        return
    ranges = (*ceilings.CLASSIC_RANGE, *ceilings.TOOL_RANGE)
    for j, (low, high) in enumerate(ranges):
        assert low <= envelope.lower[j] < envelope.upper[j] <= high
        assert 0.0 < envelope.max_speed[j] <= ceilings.MAX_SPEED[j]
        assert 0.0 < envelope.max_acceleration[j] <= ceilings.MAX_ACCELERATION[j]
        assert 0.0 < envelope.max_jerk[j] <= ceilings.MAX_JERK[j]
    assert min(envelope.margin) >= min(ceilings.MIN_POSITION_MARGIN)
    assert 0.0 <= envelope.measured_slack <= ceilings.MEASURED_SLACK
    for j, near in enumerate(envelope.first_command):
        assert 0.0 < near <= ceilings.FIRST_COMMAND[j == 2]
    assert 0.0 < envelope.feedback_period <= ceilings.MAX_FEEDBACK_PERIOD_S


@FEW
@given(st.floats(0.2, 1.0), st.sampled_from(range(6)), st.floats(0.1, 3.0))
def test_a_stricter_file_is_never_milder(factor, joint, part):
    first = CELL.arms[0]
    joints = []
    for old in first.arm.joints:
        rates = [key for key in type(old).model_fields if key.startswith("max_")]
        joints.append(old.model_copy(update={key: getattr(old, key) * factor for key in rates}))
    strict = replace(first, arm=replace(first.arm, joints=tuple(joints)))
    cell = replace(CELL, arms=(strict, *CELL.arms[1:]))
    step = part * CellEnvelope.of(CELL, PERIOD).arms[0].max_speed[joint] * PERIOD
    outcomes = []
    for description in (cell, CELL):
        rig = Rig(cell=description)
        assert rig.arm() == ()
        outcomes.append(rig.ask(rig.moved(0, joint, step)).action)
    assert outcomes[0] >= outcomes[1]


@FEW
@given(SWINGS, st.lists(ALL_ACTIONS, min_size=1, max_size=6))
def test_a_rehearsal_judges_like_the_gate(swing, kinds):
    gate = Rig()
    trial = Rehearsal(CELL, PERIOD)
    refused = gate.state()
    agreed = replace(refused, inputs=replace(refused.inputs, consent=True))
    assert trial.begin(refused, agreed, gate.now) == ()
    assert gate.arm() == ()
    joint, part, cycles = swing
    asked: list[tuple[JointSetpoint, ...] | None] = []
    for speed in islice(gate.speeds(joint, part * TOPS[joint]), cycles):
        asked.append(gate.moved(0, joint, -speed * PERIOD))
        compare(gate, trial, asked[-1])
    for kind in kinds:
        compare(gate, trial, asked_for(gate, kind))


def compare(rig: Rig, trial: Rehearsal, asked) -> None:
    rig.now += PERIOD
    rig.ticks += 1
    state, request = rig.state(), Request(asked)
    decision = rig.gate.check(state, request, rig.now)
    assert list(map(repr, trial.judge(state, request, rig.now))) == list(
        map(repr, decision.verdicts)
    )
    rig.older, rig.before = rig.before, rig.held
    rig.held = tuple(checked.setpoint for checked in decision.setpoints)


@FEW
@given(st.lists(st.sampled_from([True, False, None, 1, "yes"]), max_size=8))
def test_only_a_rising_edge_of_a_plain_yes_arms(words_of_consent):
    rig, saw_no = Rig(), False
    for consent in words_of_consent:
        rig.consent = consent
        saw_no = saw_no or consent is False
        against = rig.gate.arm(rig.state(), rig.now)
        if consent is True and saw_no:
            assert against == ()
            assert rig.gate.mode is Mode.ARMED
            return
        assert against
        assert rig.gate.mode is Mode.READY


@FEW
@given(SWINGS, st.integers(0, 80), st.booleans())
def test_a_hold_is_cleared_only_at_rest_clean_and_with_consent(swing, waited, consent):
    rig = moving(swing)
    rig.ask(None)
    decisions = [rig.ask(rig.stay()) for _ in range(waited)]
    rested = bool(decisions) and decisions[-1].at_rest
    assume(abs(waited * PERIOD - CLEAN_S) > 1e-6)
    rig.consent = consent
    against = rig.gate.resume(rig.state(), rig.now)
    assert (against == ()) == (rested and waited * PERIOD > CLEAN_S and consent)
    assert rig.gate.mode is (Mode.RUNNING if against == () else Mode.HOLDING)


@FEW
@given(SWINGS, st.sampled_from([0, 1]), st.integers(0, 5), st.floats(1.01, 50.0))
def test_what_comes_after_a_hold_starts_where_the_robot_is(swing, arm, joint, factor):
    rig = moving(swing)
    rig.ask(None)
    for _ in range(120):
        rig.ask(rig.stay())
    assert rig.gate.resume(rig.state(), rig.now) == ()
    limit = rig.gate.envelope.arms[arm].first_command[joint]
    decision = rig.ask(rig.moved(arm, joint, factor * limit))
    assert "S09" in {v.rule for v in decision.verdicts}
    assert not decision.passed


def test_two_gates_of_one_process_share_nothing():
    one, other = Supervisor(CELL, PERIOD), Rig.running()
    assert one.mode is Mode.OFF
    other.gate.report_fault("S24", other.now)
    other.ask(other.stay())
    assert other.gate.mode is Mode.FAULT
    assert one.mode is Mode.OFF
