import math
from dataclasses import replace
from itertools import islice

import pytest
from gate_rig import PERIOD, Rig

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import SafetyStop
from viskill_deploy.core.types import Action, JointSetpoint, Mode, Verdict
from viskill_deploy.safety import rule_base
from viskill_deploy.safety.rule_base import REQUIRED, find_rules
from viskill_deploy.safety.supervisor import Supervisor


def reasons(verdicts: tuple[Verdict, ...]) -> set[str]:
    return {verdict.rule for verdict in verdicts}


# Up to READY and ARMED -----------------------------------------------------------------------


def test_a_new_supervisor_is_off_and_sends_nothing():
    rig = Rig()
    assert rig.gate.mode is Mode.OFF
    decision = rig.ask(rig.stay())
    assert decision.setpoints == ()
    assert decision.action is Action.HOLD
    assert not decision.passed
    assert not decision.at_rest


def test_the_mode_follows_the_evidence_up_and_down():
    rig = Rig()
    steps = [
        ({"tool": "another"}, Mode.CONNECTED),
        ({"operating_state": "DISABLED"}, Mode.CONNECTED),
        ({"is_homed": False}, Mode.CONNECTED),
        ({"is_busy": True}, Mode.HOMED),
        ({"measured_jp": (3.0, 0.0, 0.1, 0.0, 0.0, 0.0)}, Mode.HOMED),
        ({}, Mode.READY),
        ({"valid": False}, Mode.CONNECTED),
    ]
    for fields, mode in steps:
        rig.broken[1] = fields
        assert rig.gate.connect(rig.state()) is mode


def test_arming_takes_a_rising_edge_of_consent():
    rig = Rig()
    rig.consent = True
    rig.gate.connect(rig.state())
    assert reasons(rig.gate.arm(rig.state(), rig.now)) == {"S22"}
    rig.consent = False
    assert reasons(rig.gate.arm(rig.state(), rig.now)) == {"S22"}
    rig.consent = True
    assert rig.gate.arm(rig.state(), rig.now) == ()
    assert rig.gate.mode is Mode.ARMED


def test_an_edge_is_good_for_one_arming_only():
    rig = Rig.running()
    rig.gate.report_fault("S24", rig.now)
    rig.rest()
    assert rig.gate.reset(rig.now) is Mode.CONNECTED
    rig.gate.connect(rig.state())
    assert reasons(rig.gate.arm(rig.state(), rig.now)) == {"S22"}
    assert rig.arm() == ()


@pytest.mark.parametrize(
    ("fields", "rule"),
    [
        ({"tool": "another"}, "S02"),
        ({"measured_jp": (math.nan,) * 6}, "S02"),
        ({"operating_state": "DISABLED"}, "S23"),
        ({"measured_jp": (3.0, 0.0, 0.1, 0.0, 0.0, 0.0)}, "S04"),
        ({"is_busy": True}, "S09"),
        ({"stamp_s": 0.0}, "S18"),
        ({"stamp_s": 0.93}, "S18"),
    ],
)
def test_arming_says_why_not(fields, rule):
    rig = Rig()
    rig.broken[1] = fields
    verdicts = rig.arm()
    assert reasons(verdicts) == {rule}
    assert rig.gate.mode is not Mode.ARMED
    assert rig.ask(rig.stay()).setpoints == ()
    rig.broken.clear()
    assert rig.arm() == ()


def test_a_cell_that_is_armed_is_not_armed_again():
    rig = Rig()
    assert rig.arm() == ()
    assert reasons(rig.arm()) == {"S09"}
    assert rig.gate.mode is Mode.ARMED


def test_an_arm_in_its_cannula_can_be_armed_and_inserted():
    rig = Rig()
    jp = (0.0, 0.0, 0.03, 0.0, 0.0, 0.0)
    rig.held = tuple(JointSetpoint(jp, (0.0,) * 6, 0.3, 0.0) for _ in rig.held)
    assert rig.arm() == ()
    rig.run()
    assert rig.ask(rig.moved(0, 2, 1e-6)).passed
    assert rig.ask(rig.moved(0, 0, 1e-6)).action is Action.HOLD


def test_a_report_before_arming_forbids_it():
    rig = Rig()
    rig.consent = False
    rig.gate.connect(rig.state())
    rig.consent = True
    rig.gate.report_fault("S24", rig.now)
    assert reasons(rig.gate.arm(rig.state(), rig.now)) == {"S24"}
    assert rig.gate.mode is Mode.FAULT
    assert rig.gate.reset(rig.now) is Mode.CONNECTED
    assert rig.arm() == ()


def test_a_report_before_arming_is_latched_by_a_check_too():
    rig = Rig()
    rig.gate.report_fault("S24", rig.now)
    decision = rig.ask(rig.stay())
    assert (decision.action, decision.mode) == (Action.FAULT, Mode.FAULT)
    assert rig.arm() != ()


def test_the_first_setpoint_after_arming_is_near_the_drivers():
    rig = Rig()
    assert rig.arm() == ()
    decision = rig.ask(rig.moved(1, 3, 0.021))
    assert "S09" in reasons(decision.verdicts)
    assert decision.action is Action.HOLD
    assert rig.held == decision_setpoints(decision)
    assert rig.held[1].jp == pytest.approx(Rig().held[1].jp, abs=1e-15)


# Passing -------------------------------------------------------------------------------------


def decision_setpoints(decision) -> tuple[JointSetpoint, ...]:
    return tuple(checked.setpoint for checked in decision.setpoints)


def test_a_good_request_goes_out_as_the_very_same_objects():
    rig = Rig.running()
    asked = rig.moved(0, 2, 1e-7)
    decision = rig.ask(asked)
    assert decision.passed
    assert all(
        ours is theirs for ours, theirs in zip(decision_setpoints(decision), asked, strict=True)
    )
    assert [checked.arm for checked in decision.setpoints] == [0, 1]
    assert decision.action is Action.PASS
    assert decision.verdicts == ()
    assert decision.speed_scale == 1.0
    assert decision.mode is Mode.RUNNING


def test_margins_stand_in_the_order_of_the_rules():
    rig = Rig.running()
    decision = rig.ask(rig.stay())
    assert len(decision.margins) == len(rig.gate.rules) == len(set(rig.gate.rules))
    margins = dict(zip(rig.gate.rules, decision.margins, strict=True))
    assert margins["S05"] == margins["S06"] == margins["S10"] == 1.0
    assert 0.0 < margins["S11"] < 1.0
    decision = rig.ask(rig.stay(), waypoint_due_s=rig.now + PERIOD - 0.05)
    assert decision.margins[rig.gate.rules.index("S19")] == pytest.approx(0.5, abs=1e-6)


def test_a_little_too_fast_passes_and_asks_the_time_base_to_slow_down():
    rig = Rig.running()
    decision = rig.swing(60, top=0.055)
    assert decision.passed
    assert decision.action is Action.SCALE
    assert decision.speed_scale == pytest.approx(0.05 / 0.055)
    assert reasons(decision.verdicts) == {"S10"}
    assert rig.gate.mode is Mode.RUNNING
    rig.held = tuple(replace(held, jv=(0.0,) * 6) for held in rig.held)


def test_scale_ends_by_itself():
    rig = Rig.running()
    rig.swing(60, top=0.055)
    for speed in islice(rig.speeds(2, 0.045, start=0.055), 20):
        decision = rig.ask(rig.moved(0, 2, -speed * PERIOD))
    assert decision.action is Action.PASS
    assert decision.speed_scale == 1.0


def test_one_overrun_is_a_warning_and_passes():
    rig = Rig.running()
    decision = rig.ask(rig.stay(), dt=0.02)
    assert decision.passed
    assert decision.action is Action.WARN
    assert reasons(decision.verdicts) == {"S20"}
    assert decision.speed_scale == 1.0


# Stopping ------------------------------------------------------------------------------------


def test_a_hold_stops_both_arms_with_one_jerk_limited_stop():
    rig = Rig.running()
    rig.swing(40)
    start = rig.held
    first = rig.ask(None, failure="infeasible")
    assert first.action is Action.HOLD
    assert first.mode is Mode.HOLDING
    assert not first.passed
    assert not first.at_rest
    assert first.setpoints[0].setpoint.jp[2] != start[0].jp[2]
    decisions = rig.rest()
    assert all(decision.action is Action.HOLD for decision in decisions)
    end = decision_setpoints(decisions[-1])
    assert end[0].jv == (0.0,) * 6
    assert decision_setpoints(rig.ask(rig.stay())) == end


def test_while_holding_no_request_goes_out():
    rig = Rig.running()
    rig.ask(None, failure="infeasible")
    rig.rest()
    before = rig.held
    for _ in range(20):
        decision = rig.ask(rig.moved(0, 2, 1e-7))
        assert not decision.passed
        assert rig.held == before
    assert decision.margins[rig.gate.rules.index("S03")] == 1.0


def test_an_operator_resumes_from_rest_after_a_clean_while():
    rig = Rig.running()
    rig.swing(40)
    rig.ask(None, failure="infeasible")
    assert reasons(rig.gate.resume(rig.state(), rig.now)) == {"S16"}
    rig.rest()
    waited = 0
    while rig.gate.resume(rig.state(), rig.now):
        rig.ask(rig.stay())
        waited += 1
        assert waited < 100
    assert rig.gate.mode is Mode.RUNNING
    assert waited > 0
    decision = rig.ask(rig.stay())
    assert decision.passed
    rig.swing(40)


def test_the_clean_while_starts_anew_with_each_new_trouble():
    rig = Rig.running()
    rig.ask(None, failure="infeasible")
    for _ in range(45):
        rig.ask(rig.stay())
    rig.broken[0] = {"stamp_s": rig.now - 0.07}
    rig.ask(rig.stay())
    rig.broken.clear()
    for _ in range(45):
        rig.ask(rig.stay())
    assert reasons(rig.gate.resume(rig.state(), rig.now)) == {"S18"}
    for _ in range(5):
        rig.ask(rig.stay())
    assert rig.gate.resume(rig.state(), rig.now) == ()


def test_resume_takes_a_hold_consent_and_no_open_report():
    rig = Rig.running()
    assert reasons(rig.gate.resume(rig.state(), rig.now)) == {"S09"}
    rig.ask(None, failure="infeasible")
    rig.rest()
    for _ in range(60):
        rig.ask(rig.stay())
    rig.consent = False
    assert reasons(rig.gate.resume(rig.state(), rig.now)) == {"S22"}
    rig.consent = True
    assert rig.gate.resume(rig.state(), rig.now - 1.0) != ()
    rig.gate.report_fault("S24", rig.now)
    assert rig.gate.resume(rig.state(), rig.now) != ()


def test_after_a_resume_the_first_setpoint_is_near_the_drivers():
    rig = Rig.running()
    rig.ask(None, failure="infeasible")
    for _ in range(60):
        rig.ask(rig.stay())
    assert rig.gate.resume(rig.state(), rig.now) == ()
    assert "S09" in reasons(rig.ask(rig.moved(0, 0, 0.03)).verdicts)


@pytest.mark.parametrize("rule", ["S24", "S99", "S32"])
def test_faults_and_stops_are_not_resumed(rule):
    rig = Rig.running()
    rig.gate.report_fault(rule, rig.now, 5.0)
    decision = rig.ask(rig.stay())
    assert decision.action is (Action.STOP if rule == "S32" else Action.FAULT)
    assert [(v.rule, v.value) for v in decision.verdicts] == [(rule, 5.0)]
    for _ in range(100):
        decision = rig.ask(rig.stay())
    assert decision.action is (Action.STOP if rule == "S32" else Action.FAULT)
    assert decision.verdicts == ()
    assert rig.gate.resume(rig.state(), rig.now) != ()
    assert rig.gate.reset(rig.now) is Mode.CONNECTED
    assert rig.ask(rig.stay()).setpoints == ()
    assert rig.arm() == ()
    rig.run()


def test_a_reset_waits_for_rest():
    rig = Rig.running()
    rig.swing(40)
    assert rig.gate.reset(rig.now) is Mode.RUNNING
    rig.gate.report_fault("S24", rig.now)
    rig.ask(rig.stay())
    assert rig.gate.reset(rig.now) is Mode.FAULT
    rig.rest()
    assert rig.gate.reset(rig.now) is Mode.CONNECTED


def test_a_worse_verdict_escalates_a_running_stop_without_a_jolt():
    rig, twin = Rig.running(), Rig.running()
    for each in (rig, twin):
        each.swing(40)
        each.ask(None, failure="infeasible")
    rig.gate.report_fault("S24", rig.now)
    for _ in range(60):
        assert decision_setpoints(rig.ask(rig.stay())) == decision_setpoints(twin.ask(twin.stay()))
    assert (rig.gate.mode, twin.gate.mode) == (Mode.FAULT, Mode.HOLDING)


def test_a_milder_verdict_does_not_soften_a_fault():
    rig = Rig.running()
    rig.gate.report_fault("S24", rig.now)
    rig.ask(rig.stay())
    decision = rig.ask(None, failure="infeasible")
    assert decision.action is Action.FAULT
    assert reasons(decision.verdicts) == {"S16"}


def test_an_emergency_stop_is_for_good_in_every_mode():
    for rig in (Rig(), Rig.running()):
        rig.estop = True
        decision = rig.ask(rig.stay())
        assert (decision.action, decision.mode) == (Action.ESTOP, Mode.ESTOPPED)
        rig.estop = False
        for _ in range(100):
            rig.ask(rig.stay())
        assert rig.gate.resume(rig.state(), rig.now) != ()
        assert rig.gate.reset(rig.now) is Mode.ESTOPPED
        assert rig.gate.connect(rig.state()) is Mode.ESTOPPED
        assert rig.arm() != ()
        assert rig.ask(rig.stay()).action is Action.ESTOP


def test_an_emergency_stop_acts_while_connecting():
    rig = Rig()
    rig.estop = True
    assert rig.gate.connect(rig.state()) is Mode.ESTOPPED


def test_over_the_speed_ceiling_the_run_ends():
    rig = Rig.running()
    decision = rig.ask(rig.moved(0, 2, 0.0011))
    assert decision.action is Action.STOP
    assert decision.mode is Mode.HOLDING
    rig.rest()
    assert rig.gate.resume(rig.state(), rig.now) != ()


def test_a_run_stops_when_the_operator_lets_go_and_goes_on_with_the_same_source_only():
    rig = Rig.running()
    rig.swing(40)
    rig.consent = False
    first = rig.ask(rig.going_on())
    assert (first.action, reasons(first.verdicts)) == (Action.HOLD, {"S22"})
    rig.rest()
    rig.consent = True
    for _ in range(60):
        rig.ask(rig.stay())
    assert rig.gate.resume(rig.state(), rig.now) == ()
    rig.run()
    rig.said = {"consent_source": "another"}
    assert reasons(rig.ask(rig.stay()).verdicts) == {"S22"}


def test_a_second_run_that_ends_on_its_tracking_error_is_a_fault():
    rig, modes = Rig.running(), []
    for _ in range(3):
        rig.broken[0] = {"measured_jp": (rig.held[0].jp[0] + 0.06, *rig.held[0].jp[1:])}
        for _ in range(20):
            rig.ask(rig.stay())
        modes.append(rig.gate.mode)
        rig.broken.clear()
        assert rig.gate.reset(rig.now) is Mode.CONNECTED
        assert rig.arm() == ()
        rig.run()
    assert modes == [Mode.HOLDING, Mode.FAULT, Mode.FAULT]


class Jolt:
    """A stop that goes on and then jumps: what no stop may be."""

    def __init__(self, stop):
        self.stop, self.duration_s = stop, stop.duration_s

    def at(self, t):
        setpoint = self.stop.at(t)
        return replace(setpoint, jaw=setpoint.jaw + (1e-3 if t > 0.02 else 0.0))


def test_the_gate_holds_its_own_stop_against_the_limit_of_jerk():
    rig = Rig.running()
    rig.swing(40)
    assert rig.ask(None, failure="infeasible").action is Action.HOLD
    rig.gate._stops[1] = Jolt(rig.gate._stops[1])
    decisions = [rig.ask(rig.stay()) for _ in range(5)]
    assert [d.action for d in decisions] == [Action.HOLD] * 4 + [Action.FAULT]
    (verdict,) = decisions[-1].verdicts
    assert (verdict.rule, verdict.arm, verdict.limit) == ("S07", 1, 1.0)
    assert verdict.value == pytest.approx(1e-3 / PERIOD**3 / 1260.0)
    assert rig.gate.mode is Mode.FAULT
    rig.rest()
    assert rig.gate.reset(rig.now) is Mode.CONNECTED


# No way to take a rule out --------------------------------------------------------------------


def rules_of() -> str:
    return rule_base.rules.__name__ + "."


def test_every_required_rule_is_there():
    first = {f"S{number:02d}" for number in range(1, 27)}
    assert sorted(REQUIRED - first) == ["S29", "S30", "S32"]
    assert first < REQUIRED
    assert {rule.id for rule in find_rules()} >= REQUIRED


def test_two_files_with_one_rule_do_not_start(monkeypatch):
    modules = list(rule_base.pkgutil.iter_modules(rule_base.rules.__path__, rules_of()))
    monkeypatch.setattr(rule_base.pkgutil, "iter_modules", lambda *_: [*modules, modules[0]])
    with pytest.raises(SafetyStop, match="not complete"):
        find_rules()


def test_an_installation_without_a_rule_does_not_start(monkeypatch):
    modules = list(rule_base.pkgutil.iter_modules(rule_base.rules.__path__, "x."))
    kept = [m for m in modules if "s24" not in m.name]
    kept = [m._replace(name=m.name.replace("x.", rule_base.rules.__name__ + ".")) for m in kept]
    monkeypatch.setattr(rule_base.pkgutil, "iter_modules", lambda *_: kept)
    with pytest.raises(SafetyStop, match="S24"):
        Supervisor(load_cell("bipegtransfer"), PERIOD)


def test_a_file_with_a_new_rule_is_found_and_on(tmp_path, monkeypatch):
    (tmp_path / "s99_never.py").write_text(
        "from viskill_deploy.core.types import Action, Verdict\n"
        "from viskill_deploy.safety.rule_base import Needs\n"
        "class Rule:\n"
        "    id, needs = 'S99', Needs.NOTHING\n"
        "    def __init__(self, cell): pass\n"
        "    def margin(self, cycle): return float('nan')\n"
        "    def judge(self, cycle): yield Verdict('S99', Action.FAULT)\n"
    )
    paths = [*rule_base.rules.__path__, str(tmp_path)]
    monkeypatch.setattr(rule_base.rules, "__path__", paths)
    rig = Rig()
    assert "S99" in rig.gate.rules
    assert reasons(rig.arm()) == {"S99"}
