"""A clock that goes back, an operator who is too early, measurements that cannot be used."""

import dataclasses
import importlib
import pkgutil
from math import nan

import pytest
from gate_rig import Rig

import viskill_deploy.safety
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


def test_two_cycles_at_one_time_have_no_time_between_them():
    rig = Rig()
    cycle = Cycle(rig.gate.envelope)
    cycle.begin(rig.state(), Request(rig.stay()), 1.0)
    assert (cycle.now, cycle.dt) == (1.0, rig.period)
    cycle.is_first = False
    for now, dt in [(1.5, 0.5), (1.5, 0.0), (1.25, 0.0), (1.75, 0.25)]:
        cycle.begin(rig.state(), Request(rig.stay()), now)
        assert cycle.dt == pytest.approx(dt)
    assert (cycle.now, cycle.given_now) == (1.75, 1.75)


def test_nothing_that_the_gate_decided_or_decides_by_can_be_changed_later():
    found = []
    for module in pkgutil.walk_packages(viskill_deploy.safety.__path__, "viskill_deploy.safety."):
        for value in vars(importlib.import_module(module.name)).values():
            if isinstance(value, type) and dataclasses.is_dataclass(value):
                found.append(value.__name__)
                assert value.__dataclass_params__.frozen, value
    assert {"Apart", "ArmEnvelope", "CellEnvelope", "Chain", "Decision"} <= set(found)
