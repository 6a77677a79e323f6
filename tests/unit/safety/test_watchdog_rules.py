"""When the watchdog steps in, what it shares with the runtime, and what the gate makes of it."""

import math
import os

import numpy as np
import pytest
from gate_rig import PERIOD, RULES, Rig, words

from viskill_deploy.core.types import Action, Mode, Request
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.supervisor import CLEAN_S
from viskill_deploy.safety.watchdog import (
    DISABLE_S,
    LOST_S,
    RELEASED,
    Heartbeat,
    Reaction,
    Watchdog,
)

T = 1000.0


# The watchdog ---------------------------------------------------------------------------------


def test_the_thresholds_are_those_of_the_documents():
    assert (LOST_S, DISABLE_S) == (0.05, 0.5)


@pytest.mark.parametrize("age", [0.0, 1e-6, 0.004, 0.0499])
def test_a_watchdog_waits_while_the_heart_beats(age):
    assert Watchdog().look(T - age, T, False) is Reaction.WAIT


@pytest.mark.parametrize("age", [0.05001, 0.1, 1e9, math.inf, math.nan, -1e-6, -math.inf])
def test_a_watchdog_holds_when_the_last_beat_is_old_or_no_time_of_the_past(age):
    assert Watchdog().look(T - age, T, False) is Reaction.HOLD


def test_a_beat_is_lost_exactly_at_the_threshold():
    assert 2.0 * LOST_S - LOST_S == LOST_S  # no rounding in this one
    assert Watchdog().look(LOST_S, 2.0 * LOST_S, False) is Reaction.HOLD
    assert Watchdog().look(LOST_S, math.nextafter(2.0 * LOST_S, 0.0), False) is Reaction.WAIT


def test_nothing_is_expected_of_a_runtime_that_moves_nothing():
    dog = Watchdog()
    assert [dog.look(RELEASED, T + s, False) for s in (0.0, 1.0, 1e6)] == [Reaction.WAIT] * 3


@pytest.mark.parametrize("beat", [RELEASED, T])
def test_a_runtime_that_died_is_held_at_once_and_disabled_later(beat):
    dog = Watchdog()
    assert dog.look(beat, T, True) is Reaction.HOLD
    assert dog.look(beat, T + DISABLE_S - LOST_S - 1e-6, True) is Reaction.HOLD
    assert dog.look(beat, T + DISABLE_S - LOST_S, True) is Reaction.DISABLE


def test_half_a_second_after_the_last_beat_the_power_is_gone():
    dog, seen = Watchdog(), []
    for tick in range(200):
        seen.append(dog.look(T, T + 0.004 * tick, False))
    assert seen.index(Reaction.HOLD) * 0.004 == pytest.approx(LOST_S, abs=0.0041)
    assert seen.index(Reaction.DISABLE) * 0.004 == pytest.approx(DISABLE_S, abs=0.0041)
    assert set(seen[: seen.index(Reaction.HOLD)]) == {Reaction.WAIT}
    assert set(seen[seen.index(Reaction.DISABLE) :]) == {Reaction.DISABLE}


@pytest.mark.parametrize("beat_at", [lambda now: now, lambda now: RELEASED])
def test_a_watchdog_that_has_stepped_in_never_goes_back(beat_at):
    dog = Watchdog()
    assert dog.look(T, T + 0.06, False) is Reaction.HOLD
    assert dog.look(beat_at(T + 0.07), T + 0.07, False) is Reaction.HOLD
    for now in (T + 0.6, T + 1e6):
        assert dog.look(beat_at(now), now, False) is Reaction.DISABLE


# The page -------------------------------------------------------------------------------------


def test_what_one_side_writes_the_other_side_reads():
    page = os.memfd_create("test")
    os.ftruncate(page, Heartbeat.SIZE)
    ours, theirs = Heartbeat(page), Heartbeat(page)
    assert (theirs.beat_s, theirs.watched_s, theirs.has_stepped_in) == (RELEASED, 0.0, False)
    ours.beat_s = 12.5
    assert (theirs.beat_s, theirs.watched_s, theirs.has_stepped_in) == (12.5, 0.0, False)
    theirs.watched_s = 12.25
    assert (ours.beat_s, ours.watched_s, ours.has_stepped_in) == (12.5, 12.25, False)
    theirs.step_in()
    assert (ours.beat_s, ours.watched_s, ours.has_stepped_in) == (12.5, 12.25, True)
    ours.close()
    assert theirs.beat_s == 12.5
    theirs.close()
    os.close(page)


# The gate -------------------------------------------------------------------------------------


def cycle_with(**told) -> Cycle:
    rig = Rig()
    for key, value in told.items():
        setattr(rig, key, value)
    cycle = Cycle(rig.gate.envelope)
    cycle.begin(rig.state(), Request(rig.stay()), rig.now)
    return cycle


def made(rule_id: str):
    return RULES[rule_id](Rig().gate.envelope)


@pytest.mark.parametrize("age", [0.0, -0.0, 0.004, 0.0499, 0.05, -0.0499, -0.05, 5e-324])
def test_s26_is_content_with_a_watchdog_that_looked_lately(age):
    assert words(made("S26"), cycle_with(watchdog_s=1.0 - age)) == []
    assert words(made("S26"), cycle_with(watchdog_s=np.float64(1.0 - age))) == []


@pytest.mark.parametrize("age", [0.0501, 0.1, 1e9, -0.0501, -1e9, math.inf, -math.inf, math.nan])
def test_s26_stops_without_a_watchdog(age):
    (verdict,) = words(made("S26"), cycle_with(watchdog_s=1.0 - age))
    assert (verdict.action, verdict.arm, verdict.limit) == (Action.STOP, -1, LOST_S)
    assert verdict.value == pytest.approx(abs(age), nan_ok=True)


@pytest.mark.parametrize("stamp", [1, True, "1.0", np.float32(1.0), (1.0,)])
def test_s26_takes_nothing_but_a_time_for_a_time(stamp):
    (verdict,) = words(made("S26"), cycle_with(watchdog_s=stamp))
    assert (verdict.action, verdict.value) == (Action.STOP, math.inf)


def test_s26_margin_is_the_part_of_the_threshold_that_is_left():
    assert made("S26").margin(cycle_with(watchdog_s=1.0 - 0.01)) == pytest.approx(0.8)


def test_s25_is_content_while_the_watchdog_has_not_stepped_in():
    assert words(made("S25"), cycle_with()) == []


@pytest.mark.parametrize("told", [True, None, 0, 1, "", np.False_, math.nan])
def test_s25_is_an_emergency_stop_on_anything_else(told):
    (verdict,) = words(made("S25"), cycle_with(watchdog_stepped_in=told))
    assert (verdict.action, verdict.arm) == (Action.ESTOP, -1)


def test_s26_a_cell_that_nobody_watches_is_not_armed():
    rig = Rig()
    rig.watchdog_s = rig.now - 0.2
    assert [(v.rule, v.action) for v in rig.arm()] == [("S26", Action.STOP)]
    rig.watchdog_s = None
    assert rig.arm() == ()


def test_s26_a_lost_watchdog_ends_the_run_after_50_ms():
    rig = Rig.running()
    rig.swing(20)
    rig.watchdog_s, lost_at = rig.now, rig.now
    while (decision := rig.ask(rig.going_on())).passed:
        pass
    assert rig.now - lost_at == pytest.approx(LOST_S, abs=PERIOD)
    assert [(v.rule, v.action) for v in decision.verdicts] == [("S26", Action.STOP)]
    rig.watchdog_s = None
    rig.rest()
    for _ in range(round(CLEAN_S / PERIOD) + 1):
        rig.ask(rig.stay())
    assert rig.gate.resume(rig.state(), rig.now) != ()
    assert rig.gate.reset(rig.now) is Mode.CONNECTED


def test_s25_a_runtime_that_was_away_does_not_go_on_and_is_never_armed_again():
    rig = Rig.running()
    rig.swing(20)
    rig.watchdog_stepped_in = True
    decision = rig.ask(rig.going_on(), dt=1.0)
    assert decision.action is Action.ESTOP
    assert not decision.passed
    rig.watchdog_stepped_in = False
    rig.rest()
    assert rig.gate.reset(rig.now) is Mode.ESTOPPED
    assert rig.arm() != ()


def test_s25_a_cell_whose_watchdog_has_stepped_in_is_not_armed():
    rig = Rig()
    rig.watchdog_stepped_in = True
    assert [v.rule for v in rig.arm()] == ["S25"]
