"""Laws of the gate: whatever it is given, what goes out is the request or a stop inside limits."""

import math
from itertools import islice

import numpy as np
import pytest
from gate_rig import PERIOD, RULES, Rig
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from viskill_deploy.core.types import Action, ArmState, Inputs, JointSetpoint, Mode, Request
from viskill_deploy.safety.decision import Decision

ANY = st.floats(allow_nan=True, allow_infinity=True)
NEAR = st.floats(-1e-3, 1e-3)
SIX = st.tuples(*[ANY] * 6)
JUNK = st.one_of(SIX, st.tuples(ANY, ANY), st.lists(ANY, max_size=7), st.none(), st.text())
QUICK = settings(max_examples=100, suppress_health_check=[HealthCheck.too_slow], deadline=None)


@st.composite
def requests(draw):
    """None, junk, a small step from where the arms are (drawn later), or anything."""
    kind = draw(st.sampled_from(["none", "junk", "near", "near", "near", "far"]))
    if kind == "none":
        missing = Request(None, failure=draw(st.sampled_from(["", "infeasible"])))
        return lambda _: missing
    if kind == "junk":
        bad = JointSetpoint(draw(JUNK), draw(JUNK), draw(ANY), draw(ANY))
        due = draw(ANY)
        return lambda rig: Request((bad, rig.stay()[1]), waypoint_due_s=due)
    steps = [draw(st.tuples(*[NEAR if kind == "near" else ANY] * 7)) for _ in range(2)]
    flags = st.sampled_from([(), (False, False), (True, False), (True, True)])
    said = {"holding": draw(flags), "may_open_jaw": draw(flags)}

    def build(rig):
        moved = [
            JointSetpoint(
                tuple(q + d for q, d in zip(s.jp, step, strict=False)), s.jv, s.jaw + step[6], 0.0
            )
            for s, step in zip(rig.going_on(), steps, strict=True)
        ]
        return Request(tuple(moved), **said)

    return build


FIELDS = {
    "measured_jp": JUNK,
    "measured_jv": JUNK,
    "setpoint_jp": JUNK,
    "stamp_s": ANY,
    "jaw_measured_jp": ANY,
    "valid": st.booleans(),
    "is_homed": st.booleans(),
    "operating_state": st.sampled_from(["ENABLED", "FAULT", "PAUSED", ""]),
    "tool": st.text(max_size=3),
    "joint_names": st.just(()),
}


@st.composite
def troubles(draw):
    """A broken field of an arm, mostly none."""
    if draw(st.integers(0, 4)):
        return {}
    name = draw(st.sampled_from(sorted(FIELDS)))
    return {name: draw(FIELDS[name])}


CYCLES = st.lists(
    st.tuples(requests(), troubles(), st.floats(-0.01, 0.5), st.integers(0, 30)),
    min_size=1,
    max_size=12,
)


def inside(rig: Rig, trail: list[tuple[JointSetpoint, ...]]) -> None:
    """Positions, speeds and accelerations of what went out, SCALE's fifth included."""
    for index, arm in enumerate(rig.gate.envelope.arms):
        q = np.array([(*row[index].jp, row[index].jaw) for row in trail])
        speed = abs(np.diff(q, axis=0)) / PERIOD
        bend = abs(np.diff(q, n=2, axis=0)) / PERIOD**2
        turn = abs(np.diff(q, n=3, axis=0)) / PERIOD**3
        v, a, j = (np.array(x) for x in (arm.max_speed, arm.max_acceleration, arm.max_jerk))
        # Until acceleration is back at zero speed may still rise: a^2 / 2J, and a T for sampling.
        rise = (1.2 * a) ** 2 / (2.0 * j) + 1.2 * a * PERIOD
        assert (speed <= 1.2 * v + rise + 1e-9).all()
        assert (bend <= 1.2 * a * (1.0 + 1e-6)).all()
        assert (turn <= 1.2 * j * (1.0 + 1e-6)).all()
        assert (q[:, :6] >= np.array(arm.lower[:6]) - 1e-9).all()
        assert (q[:, :6] <= np.array(arm.upper[:6]) + 1e-9).all()


@pytest.mark.invariant("S31", "S34")
@QUICK
@given(CYCLES, st.booleans())
def test_what_goes_out_is_the_request_bit_for_bit_or_a_stop_inside_the_limits(cycles, estop):
    rig = Rig.running()
    trail, latched, actions = [rig.before, rig.held], Action.PASS, []
    for build, trouble, dt, rests in cycles:
        rig.broken = {0: trouble} if trouble else {}
        request = build(rig)
        step(rig, request, dt, trail, actions)
        rig.broken.clear()
        for _ in range(rests):
            step(rig, Request(rig.stay()), PERIOD, trail, actions)
    rig.estop = estop
    step(rig, Request(rig.stay()), PERIOD, trail, actions)
    for action in actions:
        if latched >= Action.HOLD:
            assert action >= latched
        latched = max(latched, action)
    inside(rig, trail)


def step(rig: Rig, request: Request, dt: float, trail: list, actions: list) -> None:
    rig.now += dt
    rig.ticks += 1
    decision = rig.gate.check(rig.state(), request, rig.now)
    rig.now = max(rig.now, rig.gate._cycle.now)
    sent = tuple(checked.setpoint for checked in decision.setpoints)
    assert len(sent) == 2
    assert all(map(math.isfinite, [x for s in sent for x in (*s.jp, *s.jv, s.jaw, s.jaw_v)]))
    if decision.passed:
        assert decision.action < Action.HOLD
        assert request.setpoints is not None
        assert all(a is b for a, b in zip(sent, request.setpoints, strict=True))
    else:
        assert decision.action >= Action.HOLD
    assert decision.action >= max((v.action for v in decision.verdicts), default=Action.PASS)
    assert 0.0 < decision.speed_scale <= 1.0
    rig.older, rig.before, rig.held = rig.before, rig.held, sent
    trail.append(sent)
    actions.append(decision.action)


@pytest.mark.invariant("S34")
@QUICK
@given(st.floats(0.05, 0.9), st.integers(1, 60), st.sampled_from(range(7)), st.booleans())
def test_the_gates_own_stop_keeps_the_limit_of_jerk_from_any_moment_of_a_motion(
    part, cycles, joint, down
):
    """Also in the very first period of it, whatever speed and acceleration it starts from."""
    rig = Rig.running()
    trail = [rig.before, rig.before, rig.before, rig.held]
    top = (-part if down else part) * rig.gate.envelope.arms[0].max_speed[joint]
    for speed in islice(rig.speeds(joint, top, share=0.49), cycles):
        decision = rig.ask(rig.moved(0, joint, speed * PERIOD), holding=(False, False))
        trail.append(rig.held)
        if not decision.passed:
            break
    rig.ask(None)
    trail.append(rig.held)
    trail += [tuple(c.setpoint for c in d.setpoints) for d in rig.rest()]
    q = np.array([(*row[0].jp, row[0].jaw) for row in trail])
    turn = abs(np.diff(q, n=3, axis=0)) / PERIOD**3
    assert (turn <= np.array(rig.gate.envelope.arms[0].max_jerk) * (1.0 + 1e-6)).all()
    assert rig.gate.mode is Mode.HOLDING


@QUICK
@given(st.floats(0.001, 0.049), st.sampled_from([0, 1, 2, 3, 4, 5]))
def test_hold_never_speeds_up_a_steady_motion(part, joint):
    rig = Rig.running()
    top = part * rig.gate.envelope.arms[0].max_speed[joint]
    for speed in rig.speeds(joint, top):
        assert rig.ask(rig.moved(0, joint, speed * PERIOD)).passed
        if speed == top:
            break
    for _ in range(3):
        assert rig.ask(rig.moved(0, joint, speed * PERIOD)).passed
    places = [rig.held[0].jp[joint]]
    rig.ask(None)
    places.append(rig.held[0].jp[joint])
    rig.rest()
    speeds = np.diff(places) / PERIOD
    assert (speeds >= -1e-12).all()
    assert speeds[0] <= speed * (1 + 1e-9) + 1e-12


@QUICK
@given(requests(), troubles(), st.randoms(use_true_random=False))
def test_the_order_of_rules_does_not_matter(build, trouble, shuffle):
    outcomes = []
    for reverse in (False, True):
        rig = Rig.running()
        if reverse:
            for rules in (rig.gate._on_nothing, rig.gate._on_state, rig.gate._on_request):
                shuffle.shuffle(rules)
        rig.broken = {1: trouble} if trouble else {}
        rig.now += PERIOD
        decision: Decision = rig.gate.check(rig.state(), build(rig), rig.now)
        sent = [checked.setpoint for checked in decision.setpoints]
        outcomes.append((sent, decision.action, decision.mode, set(map(repr, decision.verdicts))))
    assert outcomes[0] == outcomes[1]


@QUICK
@given(st.lists(st.sampled_from(sorted(Action)), min_size=1, max_size=6), st.data())
def test_more_verdicts_never_make_the_action_milder(actions, data):
    """Any rule that breaks on top of others leaves the decision as severe or makes it worse."""
    rules = {Action.FAULT: "S24", Action.STOP: "S32"}
    rig, worst = Rig.running(), Action.PASS
    for action in actions:
        if action in rules:
            rig.gate.report_fault(rules[action], rig.now)
        elif action is Action.HOLD:
            worst = max(worst, rig.ask(None, failure="x").action)
        elif action is Action.ESTOP:
            rig.estop = True
        decision = rig.ask(rig.stay())
        assert decision.action >= worst
        worst = max(worst, decision.action) if decision.action >= Action.HOLD else worst


LADDER = st.sampled_from(
    ["connect", "arm", "stay", "miss", "report", "estop", "resume", "reset", "consent", "wait"]
)


@pytest.mark.invariant("S31")
@settings(max_examples=120, deadline=None)
@given(st.lists(LADDER, max_size=30))
def test_fault_and_estop_never_clear_by_themselves(moves):
    """Any order of what people and programs can do, against the table of who clears what."""
    rig = Rig()
    for move in moves:
        before = rig.gate.mode
        do(rig, move)
        after = rig.gate.mode
        if before is Mode.ESTOPPED:
            assert after is Mode.ESTOPPED
        if before is Mode.FAULT and after is not Mode.FAULT:
            assert (move, after) in {("reset", Mode.CONNECTED), ("estop", Mode.ESTOPPED)}
        if before is Mode.HOLDING and after in (Mode.RUNNING, Mode.CONNECTED):
            assert move in {"resume", "reset"}
        if after is Mode.ARMED and before is not Mode.ARMED:
            assert move == "arm"
        if after is Mode.RUNNING and before is not Mode.RUNNING:
            assert (before, move) in {
                (Mode.ARMED, "stay"),
                (Mode.ARMED, "wait"),
                (Mode.HOLDING, "resume"),
            }


def do(rig: Rig, move: str) -> None:
    if move == "connect":
        rig.gate.connect(rig.state())
    elif move == "arm":
        rig.gate.arm(rig.state(), rig.now)
    elif move == "stay":
        rig.ask(rig.stay())
    elif move == "miss":
        rig.ask(None, failure="infeasible")
    elif move == "report":
        rig.gate.report_fault("S24", rig.now)
        rig.ask(rig.stay())
    elif move == "estop":
        rig.estop = True
        rig.gate.connect(rig.state())
        rig.ask(rig.stay())
    elif move == "resume":
        rig.gate.resume(rig.state(), rig.now)
    elif move == "reset":
        rig.gate.reset(rig.now)
    elif move == "consent":
        rig.consent = not rig.consent
    else:
        for _ in range(60):
            rig.ask(rig.stay())


@pytest.mark.invariant("S31")
@pytest.mark.parametrize("rule_id", sorted(RULES))
def test_no_file_flag_or_attribute_takes_a_rule_out(rule_id):
    """Two supervisors of one process share every rule, and none has a switch."""
    first, second = Rig.running().gate, Rig.running().gate
    assert rule_id in first.rules
    assert first.rules == second.rules
    fields = {name for name in vars(RULES[rule_id]) if not name.startswith("_")}
    assert fields == {"id", "needs", "margin", "judge"}


def test_states_are_values_that_the_rig_can_break():
    """The fields that the laws break exist, so that no law passes for want of trouble."""
    assert set(FIELDS) <= set(ArmState.__slots__)
    assert "estop" in Inputs.__slots__
