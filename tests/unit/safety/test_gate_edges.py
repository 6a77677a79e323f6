"""A clock that goes back, an operator who is too early, measurements that cannot be used."""

from math import nan

from gate_rig import Rig

from viskill_deploy.core.types import Action, Mode, Request
from viskill_deploy.safety.cycle import Cycle


def test_a_clock_that_goes_back_is_not_followed():
    rig = Rig()
    cycle = Cycle(rig.gate.envelope)
    cycle.is_first = False
    cycle.begin(rig.state(), Request(None), 1.0)
    cycle.begin(rig.state(), Request(None), 1.25)
    assert (cycle.now, cycle.dt) == (1.25, 0.25)
    cycle.begin(rig.state(), Request(None), 0.5)
    assert (cycle.now, cycle.dt, cycle.given_now) == (1.25, 0.25, 0.5)


def test_a_cell_that_is_not_armed_is_not_disarmed_either():
    rig = Rig()
    assert rig.gate.disarm() is Mode.OFF
    assert rig.arm() == ()
    assert rig.gate.disarm() is Mode.CONNECTED


def test_of_measurements_that_cannot_be_used_no_rule_is_asked_that_reads_them():
    rig = Rig()
    assert rig.arm() == ()
    rig.run()
    rig.broken[0] = {"measured_jp": (nan,) * 6}
    decision = rig.ask(rig.stay())
    assert decision.action is Action.FAULT
    assert {verdict.rule for verdict in decision.verdicts} == {"S02"}
