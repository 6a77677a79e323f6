"""Exact borders, and the shortcuts of rules: how little they look at is a part of what they do."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
from gate_rig import PERIOD, RULES, Rig, words

from viskill_deploy.core.types import Action, JointSetpoint, Request
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.reach import Reach

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
