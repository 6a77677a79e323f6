"""What the gate does when something breaks, on a fake clock: each fault has a declared reaction."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
import pytest
from gate_rig import PERIOD, Rig

from viskill_deploy.core.types import Action, JointSetpoint, Mode

REST_S = 0.25
"""No stop in these tests takes longer."""

Phase = Callable[[Rig], None]


def standing(rig: Rig) -> None:
    rig.run()


def inserting(rig: Rig) -> None:
    rig.swing(40)


def turning(rig: Rig) -> None:
    rig.swing(40, joint=0, top=0.15)


def speeding_up(rig: Rig) -> None:
    rig.swing(10)


PHASES = [standing, inserting, turning, speeding_up]


@dataclass(frozen=True)
class Fault:
    """Something that goes wrong.

    Attributes:
        strike: makes it happen in one cycle and returns that cycle's decision.
        action: what the gate has to answer, within `within_s` of the first bad cycle.
        lasts_s: for how long it is kept up.
    """

    strike: Callable[[Rig], object]
    rule: str
    action: Action
    within_s: float = 0.0
    lasts_s: float = 0.0


def broken(**fields: object) -> Callable[[Rig], object]:
    def strike(rig: Rig) -> object:
        rig.broken[1] = dict(fields)
        return rig.ask(rig.going_on())

    return strike


def nan_request(rig: Rig) -> object:
    setpoints = list(rig.going_on())
    setpoints[1] = replace(setpoints[1], jp=(0.0, math.nan, 0.1, 0.0, 0.0, 0.0))
    return rig.ask(tuple(setpoints))


def nan_measurement(rig: Rig) -> object:
    return broken(measured_jp=(math.nan,) * 6)(rig)


def drop(rig: Rig) -> object:
    """No new sample arrives."""
    if not rig.broken:
        rig.broken[1] = {"stamp_s": rig.now}
    return rig.ask(rig.going_on())


def spike(rig: Rig) -> object:
    return rig.ask(rig.moved(1, 4, 0.3))


def second_commander(rig: Rig) -> object:
    return broken(setpoint_jp=tuple(q + 0.02 for q in rig.held[1].jp))(rig)


def estop(rig: Rig) -> object:
    rig.estop = True
    return rig.ask(rig.going_on())


def reported(rule: str) -> Callable[[Rig], object]:
    def strike(rig: Rig) -> object:
        rig.gate.report_fault(rule, rig.now)
        return rig.ask(rig.going_on())

    return strike


def clock_back(rig: Rig) -> object:
    return rig.ask(rig.going_on(), dt=-3600.0)


def clock_leaps(rig: Rig) -> object:
    return rig.ask(rig.going_on(), dt=3600.0)


def gap(rig: Rig) -> object:
    """The loop is away for as long as a watchdog waits."""
    return rig.ask(rig.going_on(), dt=0.06)


def overload(rig: Rig) -> object:
    return rig.ask(rig.going_on(), dt=0.02)


def infeasible(rig: Rig) -> object:
    return rig.ask(None, failure="infeasible")


H, S, F, E = Action.HOLD, Action.STOP, Action.FAULT, Action.ESTOP
FAULTS = {
    "NaN in the request": Fault(nan_request, "S01", F),
    "NaN in a measurement": Fault(nan_measurement, "S02", F),
    "wrong tool": Fault(broken(tool="another"), "S02", F),
    "joint beyond its limits": Fault(broken(measured_jp=(1.6,) + (0.0,) * 5), "S04", F),
    "feedback dropped 60 ms": Fault(drop, "S18", H, 0.056, 0.06),
    "feedback dropped 200 ms": Fault(drop, "S18", F, 0.108, 0.2),
    "spike": Fault(spike, "S08", S),
    "QP infeasible once": Fault(infeasible, "S16", H),
    "QP infeasible three times": Fault(infeasible, "S16", F, 2 * PERIOD, 2 * PERIOD),
    "emergency stop": Fault(estop, "S23", E),
    "power lost": Fault(broken(operating_state="FAULT"), "S23", F),
    "arm loses its home": Fault(broken(is_homed=False), "S23", F),
    "driver disowns its sample": Fault(broken(valid=False), "S23", F),
    "disconnect": Fault(reported("S24"), "S24", F),
    "second commander": Fault(second_commander, "S24", F),
    "recorder fails": Fault(reported("S32"), "S32", S),
    "clock goes back": Fault(clock_back, "S21", F),
    "clock leaps": Fault(clock_leaps, "S21", F),
    "loop away for 60 ms": Fault(gap, "S20", H),
    "machine overloaded": Fault(overload, "S20", H, 0.04, 0.04),
}


@pytest.mark.invariant(
    "S01", "S02", "S04", "S08", "S16", "S18", "S20", "S21", "S23", "S24", "S32", "S34"
)
@pytest.mark.parametrize("phase", PHASES, ids=lambda phase: phase.__name__)
@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_has_its_declared_reaction(name, phase):
    fault, rig = FAULTS[name], Rig.running()
    phase(rig)
    start, decisions = rig.now, []
    sent = [rig.before, rig.held]
    while True:
        decisions.append(fault.strike(rig))
        sent.append(rig.held)
        if decisions[-1].action >= fault.action or abs(rig.now - start) > fault.lasts_s + PERIOD:
            break
    decision = decisions[-1]
    assert decision.action is fault.action
    assert fault.rule in {verdict.rule for verdict in decision.verdicts}
    assert len(decisions) <= 2 + fault.within_s / PERIOD
    assert not decision.passed
    rig.broken.clear()
    rig.now = max(rig.now, start)
    for _ in range(round(REST_S / PERIOD)):
        decision = rig.ask(rig.stay())
        sent.append(rig.held)
    assert decision.at_rest
    assert decision.action is fault.action
    check_motion(sent, rig)


def check_motion(sent: list[tuple[JointSetpoint, ...]], rig: Rig) -> None:
    """What went out stayed inside speed and acceleration limits and ended at rest."""
    for index, arm in enumerate(rig.gate.envelope.arms):
        q = np.array([(*row[index].jp, row[index].jaw) for row in sent])
        v = np.diff(q, axis=0) / PERIOD
        a = np.diff(v, axis=0) / PERIOD
        j = np.diff(a, axis=0) / PERIOD
        assert (abs(v) <= np.array(arm.max_speed) * (1 + 1e-9)).all()
        assert (abs(a) <= np.array(arm.max_acceleration) * (1 + 1e-6)).all()
        assert (abs(j) <= np.array(arm.max_jerk) * (1 + 1e-6)).all()
        assert (v[-5:] == 0.0).all()


@pytest.mark.parametrize("phase", [standing, inserting], ids=lambda phase: phase.__name__)
def test_a_frozen_encoder_holds_and_then_faults(phase):
    rig = Rig.running()
    phase(rig)
    rig.broken[0] = {"measured_jp": rig.state().arms[0].measured_jp}
    start, actions = rig.now, {}
    for speed in islice(rig.speeds(2, 0.04, start=0.04 if phase is inserting else 0.0), 60):
        decision = rig.ask(rig.moved(0, 2, -speed * PERIOD))
        actions.setdefault(decision.action, rig.now - start)
    assert 0.05 < actions[Action.HOLD] < 0.11
    assert 0.1 < actions[Action.FAULT] < 0.12
    assert Action.STOP not in actions


def test_a_still_arm_may_report_the_same_numbers_for_long():
    rig = Rig.running()
    rig.broken[0] = {"measured_jp": rig.state().arms[0].measured_jp}
    rig.run(500)


@pytest.mark.parametrize(("late_s", "action"), [(0.09, Action.PASS), (0.4, Action.HOLD)])
def test_a_slow_policy_passes_and_a_hung_one_holds(late_s, action):
    rig = Rig.running()
    due, decisions = rig.now + 0.2, []
    while rig.now < due + late_s - PERIOD:
        decisions.append(rig.ask(rig.stay(), waypoint_due_s=due))
    assert max(decision.action for decision in decisions) is action
    if action is Action.HOLD:
        first = next(i for i, d in enumerate(decisions) if d.action is Action.HOLD)
        assert (first + 1) * PERIOD == pytest.approx(0.3, abs=1.5 * PERIOD)


def test_a_jaw_that_holds_something_does_not_open_unasked():
    rig = Rig.running()
    said = {"holding": (True, False), "may_open_jaw": (False, True)}
    opening = islice(rig.speeds(6, 0.25), 40)
    decisions = [rig.ask(rig.moved(0, 6, speed * PERIOD), **said) for speed in opening]
    first = next(i for i, d in enumerate(decisions) if d.action is Action.HOLD)
    assert {verdict.rule for verdict in decisions[first].verdicts} == {"S30"}
    assert rig.held[0].jaw <= 0.3 + 0.02 + 0.005


def test_a_driver_one_period_behind_is_no_second_commander():
    rig = Rig.running()
    before, decision = rig.held, None
    for speed in islice(rig.speeds(2, 0.04), 60):
        rig.broken = {
            i: {"setpoint_jp": old.jp, "jaw_setpoint_jp": old.jaw} for i, old in enumerate(before)
        }
        before = rig.held
        decision = rig.ask(rig.moved(0, 2, -speed * PERIOD))
        assert decision.passed, decision.verdicts
    assert rig.gate.mode is Mode.RUNNING


@pytest.mark.parametrize("seed", range(10))
def test_jitter_of_three_milliseconds_trips_nothing(seed):
    rig, rng, lateness = Rig.running(), np.random.default_rng(seed), 0.0
    for speed in islice(rig.speeds(2, 0.045), 90):
        late = rng.uniform(0.0, 0.003)
        direction = math.copysign(1.0, rig.held[0].jp[2] - 0.08)
        if direction < 0:
            break
        decision = rig.ask(rig.moved(0, 2, -speed * PERIOD), dt=PERIOD + late - lateness)
        lateness = late
        assert decision.action is Action.PASS, decision.verdicts
