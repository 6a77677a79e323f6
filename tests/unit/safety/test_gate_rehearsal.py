"""Disarming after a run, and a gate that judges plans without letting anything out."""

import math
from dataclasses import replace

import pytest
from gate_rig import CELL, PERIOD, Rig

from viskill_deploy.core.types import Action, Mode, Request
from viskill_deploy.safety.rehearsal import Rehearsal


def test_an_armed_cell_at_rest_is_disarmed_and_needs_a_fresh_arm() -> None:
    rig = Rig()
    assert rig.arm() == ()
    assert rig.ask(rig.stay()).passed
    assert rig.gate.disarm() is Mode.CONNECTED
    assert rig.ask(rig.stay()).setpoints == ()
    assert rig.arm() == ()


def test_a_moving_cell_is_not_disarmed() -> None:
    rig = Rig()
    rig.arm()
    assert rig.ask(rig.moved(0, 0, 1e-5)).passed
    assert rig.gate.disarm() is Mode.RUNNING


def test_a_cell_that_was_never_armed_is_not_disarmed() -> None:
    assert Rig().gate.disarm() is Mode.OFF


def test_a_latched_stop_is_not_disarmed() -> None:
    rig = Rig()
    rig.arm()
    rig.ask(None)
    for _ in range(100):
        rig.ask(rig.stay())
    assert rig.gate.disarm() in {Mode.HOLDING, Mode.FAULT}


def test_disarming_a_waiting_cell_changes_nothing() -> None:
    rig = Rig()
    rig.arm()
    rig.estop = True
    rig.ask(rig.stay())
    assert rig.gate.disarm() is Mode.ESTOPPED
    assert rig.gate._modes.disarm() is False


def rehearsed() -> tuple[Rehearsal, Rig]:
    rig = Rig()
    refused = rig.state()
    agreed = replace(refused, inputs=replace(refused.inputs, consent=True))
    rehearsal = Rehearsal(CELL, PERIOD)
    assert rehearsal.begin(refused, agreed, rig.now) == ()
    rig.consent = True
    return rehearsal, rig


def test_a_margin_that_is_no_number_counts_as_broken(monkeypatch: pytest.MonkeyPatch) -> None:
    rehearsal, rig = rehearsed()
    check = rehearsal._gate.check

    def checked(*args):
        decision = check(*args)
        return replace(decision, margins=(math.nan, 0.25, *decision.margins[2:]))

    monkeypatch.setattr(rehearsal._gate, "check", checked)
    rehearsal.judge(rig.state(), Request(rig.stay()), rig.now + PERIOD)
    first, second, *_ = rehearsal.margins.values()
    assert (first, second) == (-1.0, 0.25)


def test_a_rehearsal_judges_like_the_gate_and_returns_verdicts_alone() -> None:
    rehearsal, rig = rehearsed()
    assert rehearsal.judge(rig.state(), Request(rig.stay()), rig.now + PERIOD) == ()
    verdicts = rehearsal.judge(rig.state(), Request(rig.moved(0, 0, 0.1)), rig.now + 2 * PERIOD)
    assert max(verdict.action for verdict in verdicts) >= Action.HOLD
    assert {type(verdict).__name__ for verdict in verdicts} == {"Verdict"}


def test_a_rehearsal_says_why_it_would_not_begin() -> None:
    rig = Rig()
    rig.broken[0] = {"is_homed": False}
    state = rig.state()
    against = Rehearsal(CELL, PERIOD).begin(state, state, rig.now)
    assert against[0].rule == "S23"
