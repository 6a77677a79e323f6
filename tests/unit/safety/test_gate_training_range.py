"""S29: observations against the range of training, number by number and over time."""

import math
from dataclasses import replace

import numpy as np
import pytest
from gate_rig import CELL, PERIOD, Rig, words

from viskill_deploy.core.types import Action, Mode, ObservationRange, Request
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.rehearsal import Rehearsal
from viskill_deploy.safety.rules.s29_training_range import HOLD_AFTER_S, Rule, widened
from viskill_deploy.safety.supervisor import Supervisor

WIDTHS = [0.0, 0.001, 0.1, 0.4, 2.0, 6.28]
TRAINED = ObservationRange(tuple(0.3 - w / 2 for w in WIDTHS), tuple(0.3 + w / 2 for w in WIDTHS))
MIDDLE = (0.3,) * len(WIDTHS)
ROOM = [0.05 * width + 0.002 for width in WIDTHS]


def observed(*observations, dt=PERIOD, training=TRAINED):
    """What the rule says of some observations in turn, one every `dt` seconds."""
    rig = Rig()
    rule = Rule(CellEnvelope.of(CELL, PERIOD, training))
    cycle = Cycle(rig.gate.envelope)
    said = []
    for index, observation in enumerate(observations):
        request = Request(rig.stay(), observation=observation)
        cycle.begin(rig.state(), request, 1.0 + index * dt)
        said.append(words(rule, cycle))
    return said


def but(index, value):
    return tuple(value if i == index else x for i, x in enumerate(MIDDLE))


@pytest.mark.parametrize("entry", range(len(WIDTHS)))
@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize(("beyond", "passes"), [(-1.0, True), (0.999, True), (1.001, False)])
def test_s29_a_number_may_leave_what_training_saw_by_a_twentieth_and_a_little(
    entry, side, beyond, passes
):
    value = 0.3 + side * (WIDTHS[entry] / 2 + beyond * ROOM[entry])
    (said,) = observed(but(entry, value))
    assert [(v.action, v.arm, v.joint, v.limit) for v in said] == (
        [] if passes else [(Action.WARN, -1, -1, 1.0)]
    )


@pytest.mark.parametrize("entry", range(len(WIDTHS)))
@pytest.mark.parametrize(
    "value",
    [math.nan, math.inf, -math.inf, 1e308 * 10, 1, None, "0.3", np.float32(0.3), True, 0.3 + 0j],
)
def test_s29_a_number_that_is_none_holds_at_once(entry, value):
    (said,) = observed(but(entry, value))
    assert [(v.action, v.value) for v in said] == [(Action.HOLD, math.inf)]


@pytest.mark.parametrize("observation", [MIDDLE[:-1], (*MIDDLE, 0.3), list(MIDDLE), 5, "abc"])
def test_s29_something_else_than_the_observation_holds_at_once(observation):
    (said,) = observed(observation)
    assert [v.action for v in said] == [Action.HOLD]


def test_s29_without_a_range_no_observation_is_good():
    assert [v.action for v in observed(MIDDLE, training=None)[0]] == [Action.HOLD]
    assert observed((), training=None) == [[]]


def test_s29_a_request_without_observation_passes():
    assert observed((), MIDDLE, ()) == [[], [], []]


def test_s29_the_value_is_the_distance_as_a_part_of_half_the_range():
    half = WIDTHS[3] / 2 + ROOM[3]
    (said,) = observed(but(3, 0.3 + 1.5 * half))
    assert said[0].value == pytest.approx(1.5, rel=1e-8)
    rule = Rule(CellEnvelope.of(CELL, PERIOD, TRAINED))
    cycle = Cycle(CellEnvelope.of(CELL, PERIOD))
    cycle.begin(Rig().state(), Request(None, observation=but(3, 0.3 + 0.25 * half)), 1.0)
    assert rule.margin(cycle) == pytest.approx(0.75)
    assert widened(TRAINED).farthest(MIDDLE) < 1e-12


OUT = but(2, 1.0)


def actions(said):
    return [verdicts[0].action if verdicts else Action.PASS for verdicts in said]


def test_s29_outside_for_a_second_holds():
    assert HOLD_AFTER_S == 1.0
    fresh = [tuple(OUT) for _ in range(7)]  # a new observation in every policy step of 0.2 s
    assert actions(observed(*fresh, dt=0.2)) == [Action.WARN] * 5 + [Action.HOLD] * 2


def test_s29_the_same_observation_ages_too():
    assert actions(observed(OUT, OUT, OUT, dt=0.6)) == [Action.WARN, Action.WARN, Action.HOLD]


def test_s29_coming_back_inside_starts_the_second_anew():
    series = [OUT, OUT, OUT, MIDDLE, OUT, OUT, OUT, OUT]
    assert actions(observed(*series, dt=0.4)) == [
        *[Action.WARN] * 3, Action.PASS, *[Action.WARN] * 3, Action.HOLD
    ]  # fmt: skip


def test_s29_the_gate_warns_and_then_stops_the_cell():
    rig = Rig()
    rig.gate = Supervisor(CELL, PERIOD, TRAINED)
    assert rig.arm() == ()
    assert rig.ask(rig.stay(), observation=MIDDLE).action is Action.PASS
    warned = rig.ask(rig.stay(), observation=OUT)
    assert (warned.action, warned.passed) == (Action.WARN, True)
    for _ in range(249):
        assert rig.ask(rig.stay(), observation=OUT).passed
    held = rig.ask(rig.stay(), observation=OUT)
    assert (held.action, held.passed, held.mode) == (Action.HOLD, False, Mode.HOLDING)
    assert held.verdicts[0].rule == "S29"


def test_s29_a_rehearsal_keeps_the_smallest_margin_to_every_rule():
    rig = Rig()
    refused = rig.state()
    agreed = replace(refused, inputs=replace(refused.inputs, consent=True))
    rehearsal = Rehearsal(CELL, PERIOD, TRAINED)
    assert set(rehearsal.margins) == set(rig.gate.rules)
    assert set(rehearsal.margins.values()) == {1.0}
    assert rehearsal.begin(refused, agreed, rig.now) == ()
    rig.consent = True
    half = WIDTHS[3] / 2 + ROOM[3]
    for index, part in enumerate([0.2, 0.75, 0.5]):
        request = Request(rig.stay(), observation=but(3, 0.3 + part * half))
        rehearsal.judge(rig.state(), request, rig.now + (index + 1) * PERIOD)
    assert rehearsal.margins["S29"] == pytest.approx(0.25)
    rehearsal.judge(rig.state(), Request(rig.stay(), waypoint_due_s=math.nan), rig.now + 1.0)
    assert rehearsal.margins["S01"] < 0.0
    assert rehearsal.margins["S29"] == pytest.approx(0.25)
