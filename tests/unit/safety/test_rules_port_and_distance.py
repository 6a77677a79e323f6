"""S12 and S14: shafts in their ports, parts apart, at every level, for every pair of every cell."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from gate_rig import PERIOD, Rig, words, worst
from hypothesis import given, settings
from hypothesis import strategies as st

from viskill_deploy.core.cell_files import Clearance, KeepOut
from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.types import Action, JointSetpoint, Mode, Request
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.reach import Reach
from viskill_deploy.safety.rules import s12_port, s14_distance
from viskill_deploy.safety.stopping import ArmStop
from viskill_deploy.safety.track import ArmTrack

SPEEDS = (0.3, 0.3, 0.04, 3.0, 3.0, 3.0)
"""Of one joint at a time: a tenth to a fifth of what it may do."""


def with_keep_out(name: str) -> CellDescription:
    cell = load_cell(name)
    box = KeepOut(name="stand", lower_m=(0.03, -0.02, 0.0), upper_m=(0.06, 0.03, 0.05))
    wide = Clearance(slow_m=0.004, stop_m=0.002)
    apart = cell.file.distances.apart | {f"{p}_keep_out": wide for p in ("shaft", "wrist", "jaw")}
    distances = cell.file.distances.model_copy(update={"apart": apart, "keep_out": (box,)})
    return replace(cell, file=cell.file.model_copy(update={"distances": distances}))


@cache
def cell_of(name: str) -> CellDescription:
    return with_keep_out("bipegtransfer") if name == "keep_out" else load_cell(name)


@cache
def envelope_of(name: str) -> CellEnvelope:
    return CellEnvelope.of(cell_of(name), PERIOD)


CELLS = ("bipegtransfer", "bipegboard", "matchboardpanel", "keep_out")
PAIRS = [
    pytest.param(name, index, id=f"{name}-{apart.pair}-{index}")
    for name in CELLS
    for index, apart in enumerate(envelope_of(name).apart)
    if name != "keep_out" or apart.pair.endswith("keep_out")
]


def cycle_at(name: str, arm: int = 0, step: tuple[float, ...] = (0.0,) * 6) -> Cycle:
    """Every arm at home, one of them on its way there at a steady speed."""
    rig = Rig(cell=cell_of(name))
    cycle = Cycle(envelope_of(name))
    cycle.begin(rig.state(), Request(rig.stay()), rig.now)
    for track, setpoint in zip(cycle.tracks, rig.stay(), strict=True):
        own = step if track.index == arm else (0.0,) * 6
        before = tuple(q - d for q, d in zip(setpoint.jp, own, strict=True))
        track.begin(replace(setpoint, jp=before))
        track.step[:6] = own
        track.ask(setpoint)
    return cycle


def gaps(cycle: Cycle, index: int) -> tuple[float, float]:
    """Distance of a pair before this cycle, and the one that a stop from what is asked leaves."""
    apart = cycle.envelope.apart[index]
    ports = tuple(arm.port for arm in cycle.envelope.arms)
    ends = []
    for track in cycle.tracks:
        arm = track.envelope
        stop = ArmStop(map(track.asked_motion, range(7)), arm.max_acceleration, arm.max_jerk)
        ends.append((*stop.at(stop.duration_s).jp, 0.0))
    ways = [[t.asked_q for t in cycle.tracks], ends]
    ways.append(
        [tuple(0.5 * (x + y) for x, y in zip(*q, strict=True)) for q in zip(*ways, strict=True)]
    )
    left = min(
        apart.gap(
            ports, [t.envelope.chain.points(q) for t, q in zip(cycle.tracks, way, strict=True)]
        )
        for way in ways
    )
    return apart.gap(ports, [track.points for track in cycle.tracks]), left


@cache
def approach(name: str, index: int) -> tuple[Cycle, Cycle]:
    """The motions of one joint that bring a pair nearest and farthest."""
    arm, found = envelope_of(name).apart[index].arms[0], []
    for joint in range(6):
        for sign in (-1.0, 1.0):
            step = tuple(sign * SPEEDS[j] * PERIOD * (j == joint) for j in range(6))
            cycle = cycle_at(name, arm, step)
            before, left = gaps(cycle, index)
            found.append((left - before, len(found), cycle))
    return min(found)[2], max(found)[2]


def judged(cycle: Cycle, index: int, slow: float, stop: float):
    """What the rule says when one pair has other thresholds and the rest has none."""
    apart = replace(cycle.envelope.apart[index], slow=slow, stop=stop)
    rule = s14_distance.Rule(replace(cycle.envelope, apart=(apart,)))
    return words(rule, cycle)


@pytest.mark.parametrize(("name", "index"), PAIRS)
@pytest.mark.parametrize(
    ("slow", "stop", "action"),
    [
        (-2e-3, -4e-3, Action.PASS),
        (-1e-7, -1e-3, Action.PASS),
        (0.0, -1e-3, Action.PASS),
        (1e-6, -1e-3, Action.SCALE),
        (1e-3, -1e-6, Action.SCALE),
        (1e-3, 0.0, Action.SCALE),
        (1e-3, 1e-6, Action.STOP),
        (1e-2, 5e-3, Action.STOP),
    ],
)
@pytest.mark.invariant("S14")
def test_s14_scales_and_stops_by_what_is_left_after_a_stop(name, index, slow, stop, action):
    cycle, _ = approach(name, index)
    before, left = gaps(cycle, index)
    assert left < before
    slow, stop = left + slow, left + stop
    verdicts = judged(cycle, index, slow, stop)
    assert worst(verdicts) is action
    arms = cycle.envelope.apart[index].arms
    for verdict in verdicts:
        assert (verdict.arm, verdict.joint) == (arms[0] if arms[1] < 0 else -1, -1)
        assert verdict.value == pytest.approx(before - left, abs=1e-9)
        threshold = stop if action is Action.STOP else slow
        way = before - threshold
        assert verdict.limit == pytest.approx(way if action is Action.STOP else max(way, 0.0))


@pytest.mark.parametrize(("name", "index"), PAIRS)
@pytest.mark.invariant("S14")
def test_s14_lets_two_parts_move_apart_and_stand(name, index):
    _, away = approach(name, index)
    still = cycle_at(name)
    for cycle in (away, still):
        before, left = gaps(cycle, index)
        assert left >= before
        assert judged(cycle, index, before + 0.02, before + 0.01) == []


@pytest.mark.parametrize(("name", "index"), PAIRS)
@pytest.mark.invariant("S14")
def test_s14_stops_even_what_stands_when_two_core_lines_meet(name, index):
    cycle = cycle_at(name)
    apart = replace(cycle.envelope.apart[index], slow=1e-3, stop=5e-4)
    gap, _ = gaps(cycle, index)
    met = replace(apart, radius=apart.radius + gap) if apart.arms[1] >= 0 else apart
    if apart.arms[1] < 0:
        point = cycle.tracks[apart.arms[0]].points[(3, 0, 1)[apart.parts[0]]]
        met = replace(apart, box=(tuple(x - 0.01 for x in point), tuple(x + 0.01 for x in point)))
        verdicts = words(s14_distance.Rule(replace(cycle.envelope, apart=(met,))), cycle)
        assert [v.action for v in verdicts] == [Action.STOP]
    else:  # surfaces in each other, core lines apart: standing passes, so that a way out is left
        assert words(s14_distance.Rule(replace(cycle.envelope, apart=(met,))), cycle) == []


def test_s14_without_anything_to_keep_apart_passes():
    cycle = cycle_at("bipegtransfer")
    assert words(s14_distance.Rule(replace(cycle.envelope, apart=())), cycle) == []


@pytest.mark.parametrize(("name", "index"), PAIRS[::7])
def test_the_way_through_a_stop_is_nowhere_nearer_than_its_ends_and_middle_say(name, index):
    cycle, _ = approach(name, index)
    apart, (_, left) = cycle.envelope.apart[index], gaps(cycle, index)
    ports = tuple(arm.port for arm in cycle.envelope.arms)
    stops = [
        ArmStop(map(t.asked_motion, range(7)), t.envelope.max_acceleration, t.envelope.max_jerk)
        for t in cycle.tracks
    ]
    for time in np.linspace(0.0, max(stop.duration_s for stop in stops), 40):
        points = [
            t.envelope.chain.points(stop.at(time).jp)
            for t, stop in zip(cycle.tracks, stops, strict=True)
        ]
        assert apart.gap(ports, points) >= left - 1e-4


def wandering(name: str, seed: int, cycles: int):
    """Smooth random motion of all joints: setpoints of every arm, cycle by cycle."""
    rng, rig = np.random.default_rng(seed), Rig(cell=cell_of(name))
    q = np.array([setpoint.jp for setpoint in rig.stay()])
    v = np.zeros_like(q)
    for _ in range(cycles):
        v = 0.997 * v + 0.015 * rng.normal(size=q.shape) * np.array(SPEEDS)
        q = q + v * PERIOD
        yield tuple(JointSetpoint(tuple(row), (0.0,) * 6, 0.3, 0.0) for row in q.tolist())


@pytest.mark.parametrize("name", CELLS)
@pytest.mark.parametrize("is_tight", [False, True])
@pytest.mark.invariant("S14")
def test_looking_only_when_it_matters_gives_the_verdicts_of_looking_always(name, is_tight):
    still, seed = cycle_at(name), CELLS.index(name)
    apart = still.envelope.apart
    if is_tight:
        apart = tuple(
            replace(pair, slow=gaps(still, index)[0] - 1e-3, stop=gaps(still, index)[0] - 3e-3)
            for index, pair in enumerate(apart)
        )
    envelope = replace(still.envelope, apart=apart)
    rule, spoke, looks = s14_distance.Rule(envelope), 0, 0
    for number, setpoints in enumerate(wandering(name, seed, 250)):
        for track, setpoint in zip(still.tracks, setpoints, strict=True):
            track.ask(setpoint)
        still.is_first = True
        fresh = s14_distance.Rule(envelope)
        expected = words(fresh, still)
        still.is_first = number == 0
        due = rule._next
        assert words(rule, still) == expected
        looks += rule._next != due
        spoke += bool(expected)
        true = min(1.0, max(0.0, min(fresh._free) / s14_distance.FAR_M))
        assert expected or rule.margin(still) / 2.0 <= true + 1e-12
        for track in still.tracks:
            track.accept()
    assert spoke >= 5 if is_tight else looks <= 125


PARTS_OF_LIMITS = st.tuples(*[st.floats(-1.2, 1.2)] * 6)


@settings(max_examples=150, deadline=None)
@given(PARTS_OF_LIMITS, PARTS_OF_LIMITS, st.tuples(*[st.floats(0.05, 0.95)] * 6))
def test_no_stop_travels_farther_than_its_bound(speeds, accelerations, place):
    arm = envelope_of("bipegtransfer").arms[0]
    track = ArmTrack(0, arm, PERIOD)
    lower = (*arm.lower[:2], arm.insertion_min, *arm.lower[3:6])
    q = [a + part * (b - a) for a, b, part in zip(lower, arm.upper, place, strict=False)]
    step = [part * limit * PERIOD for part, limit in zip(speeds, arm.max_speed, strict=False)]
    bend = [
        part * limit * PERIOD**2
        for part, limit in zip(accelerations, arm.max_acceleration, strict=False)
    ]
    before = tuple(x - d for x, d in zip(q, step, strict=True))
    track.begin(JointSetpoint(before, (0.0,) * 6, 0.3, 0.0))
    track.step[:6] = [d - b for d, b in zip(step, bend, strict=True)]
    track.ask(JointSetpoint(tuple(q), (0.0,) * 6, 0.3, 0.0))
    stop = ArmStop(map(track.asked_motion, range(7)), arm.max_acceleration, arm.max_jerk)
    with_jaw = Reach(arm, PERIOD, has_jaw=True).travel(track)
    without = Reach(arm, PERIOD).travel(track)
    for time in np.linspace(0.0, stop.duration_s, 12):
        point, jaw_end, wrist, shaft_end = arm.chain.points(stop.at(time).jp)
        then = track.asked_points
        assert math.dist(jaw_end, then[1]) <= with_jaw + 1e-9
        for here, there in ((point, then[0]), (wrist, then[2]), (shaft_end, then[3])):
            assert math.dist(here, there) <= without + 1e-9


@pytest.mark.parametrize(("joint", "sign"), [(0, 1.0), (1, -1.0), (2, 1.0)])
@pytest.mark.invariant("S14")
def test_whoever_ignores_scale_is_stopped_at_the_stop_distance(joint, sign):
    """One joint goes on at a steady speed towards a keep-out box."""
    rig = Rig(cell=with_box_beside(joint, sign))
    assert rig.arm() == ()
    rig.run()
    drive_until_stopped(rig, {0: (joint, sign)})


@pytest.mark.invariant("S14")
def test_two_arms_that_go_for_each_other_are_stopped_at_the_stop_distance():
    wide = {"workspace_lower_m": (-0.14, -0.14, -0.004), "workspace_upper_m": (0.14, 0.14, 0.14)}
    cell = load_cell("bipegtransfer")
    arms = tuple(replace(arm, entry=arm.entry.model_copy(update=wide)) for arm in cell.arms)
    rig = Rig(cell=replace(cell, arms=arms))
    assert rig.arm() == ()
    rig.run()
    joints = {}
    for arm in range(2):
        found = []
        for joint in range(2):
            for sign in (-1.0, 1.0):
                step = tuple(sign * SPEEDS[j] * PERIOD * (j == joint) for j in range(6))
                cycle = cycle_at("bipegtransfer", arm, step)
                before, left = gaps(cycle, 0)
                found.append((left - before, joint, sign))
        joints[arm] = min(found)[1:]
    drive_until_stopped(rig, joints)


def drive_until_stopped(rig: Rig, joints: dict[int, tuple[int, float]]) -> None:
    """Speeds up one joint of some arms and never slows down; expects S14's word and distance."""
    part, actions = 0.0, []
    for _ in range(600):
        part = min(part + 2.0 * PERIOD, 1.0)
        setpoints = list(rig.stay())
        for arm, (joint, sign) in joints.items():
            by = sign * part * SPEEDS[joint] * PERIOD
            setpoints[arm] = rig.moved(arm, joint, by)[arm]
        decision = rig.ask(tuple(setpoints), holding=(False, False))
        actions.append(decision.action)
        if not decision.passed:
            break
    assert decision.action is Action.STOP, decision.verdicts
    assert {v.rule for v in decision.verdicts} == {"S14"}
    assert Action.SCALE in actions
    rig.rest()
    assert rig.gate.mode is Mode.HOLDING
    envelope = rig.gate.envelope
    ports = tuple(arm.port for arm in envelope.arms)
    points = [a.chain.points((*h.jp, h.jaw)) for a, h in zip(envelope.arms, rig.held, strict=True)]
    left = min(apart.gap(ports, points) - apart.stop for apart in envelope.apart)
    assert 0.0 - 1e-9 <= left <= 2e-4


def with_box_beside(joint: int, sign: float) -> CellDescription:
    """A small keep-out box where the jaw's end is a second later."""
    rig = Rig(cell=cell_of("keep_out"))
    chain, home = rig.gate.envelope.arms[0].chain, rig.stay()[0]
    way = tuple(q + sign * SPEEDS[joint] * (j == joint) for j, q in enumerate(home.jp))
    place = chain.points(way)[0 if joint == 2 else 1]
    low, high = tuple(x - 1e-3 for x in place), tuple(x + 1e-3 for x in place)
    cell = cell_of("keep_out")
    box = KeepOut(name="beside", lower_m=low, upper_m=high)
    distances = cell.file.distances.model_copy(update={"keep_out": (box,)})
    return replace(cell, file=cell.file.model_copy(update={"distances": distances}))


@pytest.mark.invariant("S14")
def test_scale_asks_the_time_base_for_the_part_of_the_way_that_is_left():
    cell = with_box_beside(2, 1.0)
    rig = Rig(cell=cell)
    assert rig.arm() == ()
    rig.run()
    speed = 0.0
    for _ in range(400):
        speed = min(speed + 0.08 * PERIOD, 0.04)
        decision = rig.ask(rig.moved(0, 2, speed * PERIOD))
        if decision.action is not Action.PASS:
            break
    assert decision.action is Action.SCALE
    assert decision.passed
    assert decision.speed_scale == min(v.limit / v.value for v in decision.verdicts)
    assert 0.0 <= decision.speed_scale < 1.0


# S12 -----------------------------------------------------------------------------------------


def with_port(name: str, arm: int, port: tuple[float, float, float]) -> CellDescription:
    cell = load_cell(name)
    arms = list(cell.arms)
    arms[arm] = replace(
        arms[arm], entry=arms[arm].entry.model_copy(update={"port_in_base_m": port})
    )
    return replace(cell, arms=tuple(arms))


@pytest.mark.parametrize("arm", range(2))
@pytest.mark.parametrize("turn", np.linspace(0.0, 2.0 * math.pi, 8, endpoint=False))
@pytest.mark.parametrize("along", [-0.004, 0.0, 0.004])
@pytest.mark.parametrize(
    ("off", "action"),
    [
        (0.0, Action.PASS),
        (0.0005, Action.PASS),
        (0.001, Action.PASS),
        (0.001001, Action.WARN),
        (0.002, Action.WARN),
        (0.002001, Action.STOP),
        (0.008, Action.STOP),
    ],
)
@pytest.mark.invariant("S12")
def test_s12_warns_and_stops_by_distance_of_the_shaft_from_its_port(arm, turn, along, off, action):
    """The port beside the shaft's axis at home, in any direction, above or below the centre."""
    q1, q2 = Rig().held[arm].jp[:2]
    shaft = np.array([math.sin(q1) * math.cos(q2), -math.sin(q2), -math.cos(q1) * math.cos(q2)])
    across = np.cross(shaft, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    side = math.cos(turn) * across + math.sin(turn) * np.cross(shaft, across)
    port = tuple((along * shaft + off * side).tolist())
    envelope = CellEnvelope.of(with_port("bipegtransfer", arm, port), PERIOD)
    rig = Rig()
    cycle = Cycle(envelope)
    for track, setpoint in zip(cycle.tracks, rig.stay(), strict=True):
        track.begin(setpoint)
    verdicts = words(s12_port.Rule(envelope), cycle)
    assert worst(verdicts) is action
    for verdict in verdicts:
        assert (verdict.arm, verdict.joint) == (arm, -1)
        assert verdict.value == pytest.approx(off, abs=1e-12)
        assert verdict.limit == (0.002 if action is Action.STOP else 0.001)


@settings(max_examples=100, deadline=None)
@given(st.tuples(*[st.floats(0.0, 1.0)] * 6))
@pytest.mark.invariant("S12")
def test_a_mechanical_remote_centre_keeps_the_shaft_in_its_own_port(place):
    cycle = cycle_at("bipegtransfer")
    arm, track = cycle.envelope.arms[0], cycle.tracks[0]
    lower = (*arm.lower[:2], arm.insertion_min, *arm.lower[3:6])
    q = tuple(a + part * (b - a) for a, b, part in zip(lower, arm.upper, place, strict=False))
    track.ask(JointSetpoint(q, (0.0,) * 6, 0.3, 0.0))
    assert s12_port.Rule(cycle.envelope).margin(cycle) == pytest.approx(1.0, abs=1e-11)


@pytest.mark.invariant("S12")
def test_a_cell_whose_port_is_two_millimetres_off_cannot_be_armed():
    rig = Rig(cell=with_port("bipegtransfer", 1, (0.0, 0.004, 0.0)))
    assert [(v.rule, v.action, v.arm) for v in rig.arm()] == [("S12", Action.STOP, 1)]


@pytest.mark.parametrize("joint", range(6))
@pytest.mark.parametrize("far", [1e3, 1e16, 1e200, -1e308])
def test_a_leap_to_nowhere_is_left_to_the_rules_on_speed(joint, far):
    cycle = cycle_at("bipegtransfer")
    rules = [s12_port.Rule(cycle.envelope), s14_distance.Rule(cycle.envelope)]
    held = cycle.tracks[1].sent
    cycle.tracks[1].ask(replace(held, jp=(*held.jp[:joint], far, *held.jp[joint + 1 :])))
    assert [rule.margin(cycle) for rule in rules] == [pytest.approx(1.0, abs=1e-11), 1.0]
    cycle.tracks[1].ask(held)
    assert rules[1].margin(cycle) < 1.0  # and looks again at all of it
    rig = Rig.running()
    decision = rig.ask(rig.moved(1, joint, far))
    assert not decision.passed
    assert {"S05", "S08"} <= {verdict.rule for verdict in decision.verdicts}
