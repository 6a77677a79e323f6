"""The guard between a client of CRTK and simulated arms, stepped and all in one process."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import cos, nan, pi, sin
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibrations import calibration_of
from silent_recorder import SilentRecorder

from viskill_deploy.core.calibration_files import calibrated
from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.types import Action, CellState, JointSetpoint, Mode, Verdict
from viskill_deploy.drivers.crtk.inproc import Inproc
from viskill_deploy.drivers.crtk.messages import (
    Empty,
    Header,
    JointState,
    OperatingState,
    PoseStamped,
    String,
    StringStamped,
    Time,
)
from viskill_deploy.drivers.crtk.simulated import SteppedCrtk
from viskill_deploy.drivers.crtk.topics import ARM
from viskill_deploy.motion.links import CellLinks
from viskill_deploy.observe.labels import rule_label
from viskill_deploy.observe.reading import read_recording
from viskill_deploy.observe.recording import Recorder
from viskill_deploy.runtime.guard import AHEAD_S, Guard
from viskill_deploy.sim.tasks.base import load_task
from viskill_deploy.sim.world import WorldOptions

CELL = load_cell("bipegtransfer")
PERIOD_S = 0.005
GOING = (Mode.ARMED, Mode.RUNNING)
ARMS = ("PSM1", "PSM2")
SIDEWAYS = np.array([0.0, 0.004, 0.0])
JOINTS = ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw")


@dataclass
class Bench:
    """Client, guard and robot, and what each of them has seen."""

    driver: SteppedCrtk
    guard: Guard
    client: Inproc
    out: dict[str, Any]
    states: dict[str, OperatingState] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    statuses: list[str] = field(default_factory=list)
    received: dict[str, list[JointState]] = field(default_factory=dict)
    told: list[tuple[tuple[str, ...], Mode]] = field(default_factory=list)
    poses: dict[str, PoseStamped] = field(default_factory=dict)
    said: list[str] = field(default_factory=list)

    def step(self, periods: int = 1) -> None:
        """Time passes, with the guard looking on."""
        clock = self.driver.clock
        for _ in range(periods):
            self.guard.turn(clock.now())
            clock.sleep_until(clock.now() + PERIOD_S)
        self.guard.turn(clock.now())

    def command(self, word: str) -> None:
        stamp = Time.of_ns(self.client.stamp_ns())
        for arm in ARMS:
            self.out[f"{arm}/state_command"](StringStamped(Header(stamp), word))

    def stream(self, arm: str, q: Sequence[float], v: Sequence[float] = (), name: str = "") -> None:
        head = Header(Time.of_ns(self.client.stamp_ns()))
        topic = f"{arm}/{name}servo_jp"
        self.out[topic](JointState(head, JOINTS if not name else ("jaw",), tuple(q), tuple(v)))

    def held(self, arm: str) -> tuple[float, ...]:
        index = ARMS.index(arm)
        return self.driver.state().arms[index].setpoint_jp

    def ready(self) -> None:
        """Enabled, homed, and agreed to by the operator."""
        self.driver.say(consent=False)
        self.step(3)
        for word in ("enable", "home"):
            self.command(word)
            self.step(5)
        self.agree()
        assert self.guard.gate.mode in GOING

    def agree(self) -> None:
        self.driver.say(consent=False)
        self.step(60)
        self.driver.say(consent=True)
        self.step(4)


@pytest.fixture
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    cell = getattr(request, "param", CELL)
    driver = SteppedCrtk(cell, WorldOptions(period_s=PERIOD_S))
    driver.connect()
    driver.reset(load_task("bipegtransfer").sample_layout(np.random.default_rng(0), "reference"))
    client = Inproc(driver.exchange)
    bench: Bench

    def tell(verdicts: Sequence[Verdict], mode: Mode) -> None:
        bench.told.append((tuple(v.rule for v in verdicts), mode))

    recorder = SilentRecorder()
    said: list[str] = []
    words = {"tell": tell, "named": rule_label, "say": said.append}
    guard = Guard(cell, driver, Inproc(driver.exchange), recorder, **words)
    out = {}
    for arm in ARMS:
        for name, kind in (
            ("servo_jp", JointState),
            ("jaw/servo_jp", JointState),
            ("servo_cp", PoseStamped),
            ("move_jp", JointState),
            ("hold", Empty),
            ("state_command", StringStamped),
        ):
            out[f"{arm}/{name}"] = client.publisher(f"/guarded/{arm}/{name}", kind)
    bench = Bench(driver, guard, client, out, said=said)
    robot = Inproc(driver.exchange)
    for arm in ARMS:
        client.subscribe(
            f"/guarded/{arm}/operating_state",
            OperatingState,
            lambda word, _, arm=arm: bench.states.update({arm: word}),
        )
        client.subscribe(
            f"/guarded/{arm}/measured_cp",
            PoseStamped,
            lambda word, _, arm=arm: bench.poses.update({arm: word}),
        )
        for name, words in (
            ("error", bench.errors),
            ("warning", bench.warnings),
            ("status", bench.statuses),
        ):
            client.subscribe(
                f"/guarded/{arm}/{name}",
                String,
                lambda word, _, words=words: words.append(word.data),
                is_latched=True,
            )
        for name in ("servo_jp", "jaw/servo_jp"):
            robot.subscribe(
                f"/{arm}/{name}",
                JointState,
                lambda word, _, key=f"{arm}/{name}": bench.received.setdefault(key, []).append(
                    word
                ),
            )
    yield bench
    guard.close()


def swing(start: Sequence[float], k: int, size: float = 0.01) -> tuple[list[float], list[float]]:
    """A smooth motion of the first joint, there and back in 200 periods, and its velocities."""
    w = pi / (200 * PERIOD_S)
    a, b = sin(w * k * PERIOD_S), cos(w * k * PERIOD_S)
    return [start[0] + size * a**4, *start[1:]], [4.0 * size * w * a**3 * b, *(0.0,) * 5]


def test_a_client_waits_for_the_operator_and_is_told_so(bench: Bench) -> None:
    bench.step(3)
    assert bench.states["PSM1"].state == "DISABLED"
    bench.command("enable")
    bench.step(5)
    bench.command("home")
    bench.step(5)
    state = bench.states["PSM2"]
    assert (state.state, state.is_homed, state.is_busy) == ("ENABLED", True, True)
    bench.stream("PSM1", swing(bench.held("PSM1"), 1)[0])
    bench.step(2)
    assert bench.received == {}, "nothing goes on before the operator agrees"
    bench.agree()
    state = bench.states["PSM2"]
    assert (state.state, state.is_homed, state.is_busy) == ("ENABLED", True, False)


def test_setpoints_pass_bit_for_bit_at_the_moment_they_come(bench: Bench) -> None:
    bench.ready()
    start = {arm: bench.held(arm) for arm in ARMS}
    jaw = bench.driver.state().arms[0].jaw_setpoint_jp
    bench.received.clear()
    asked = []
    for k in range(1, 201):
        for arm in ARMS:
            bench.stream(arm, *swing(start[arm], k))
            bench.stream(arm, [jaw], [0.0], "jaw/")
        asked.append(swing(start["PSM1"], k))
        bench.guard.turn(bench.driver.clock.now())
        assert len(bench.received["PSM1/servo_jp"]) == k, "at once, not in the next period"
        bench.driver.clock.sleep_until(bench.driver.clock.now() + PERIOD_S)
    sent = [(list(word.position), list(word.velocity)) for word in bench.received["PSM1/servo_jp"]]
    assert sent == asked
    assert bench.guard.counts.stopped == 0
    assert bench.guard.gate.mode is Mode.RUNNING
    assert bench.held("PSM1")[0] == pytest.approx(start["PSM1"][0], abs=1e-6)


def test_the_state_is_read_before_a_setpoint_is_due_and_anew_for_one_that_is_late(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.ready()
    start, clock, reads = bench.held("PSM1"), bench.driver.clock, list[CellState]()
    read = bench.driver.state

    def state() -> CellState:
        reads.append(read())
        return reads[-1]

    monkeypatch.setattr(bench.driver, "state", state)
    clock.sleep_until(bench.guard._last_s + PERIOD_S)
    for k, late_s, count in ((1, 0.0, 1), (3, 0.0, 1), (5, 0.002, 2)):
        began = clock.now()
        bench.stream("PSM1", *swing(start, k))
        due = bench.guard.turn(began)
        assert due == pytest.approx(began + PERIOD_S - AHEAD_S)
        reads.clear()
        bench.guard.turn(due)
        assert len(reads) == 1
        clock.sleep_until(began + PERIOD_S)
        bench.stream("PSM1", *swing(start, k + 1))
        bench.guard.turn(clock.now() + late_s)
        assert len(reads) == count
        clock.sleep_until(clock.now() + PERIOD_S)
    assert bench.guard.counts.stopped == 0


def test_the_time_that_late_setpoints_take_is_no_silence_of_the_client(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.ready()
    start, clock, servo_jp = bench.held("PSM1"), bench.driver.clock, bench.driver.servo_jp

    def slow(setpoints: Sequence[JointSetpoint]) -> None:
        servo_jp(setpoints)
        clock.sleep_until(clock.now() + 0.003)

    monkeypatch.setattr(bench.driver, "servo_jp", slow)
    for k in range(1, 4):
        bench.stream("PSM1", *swing(start, k))
        bench.guard.turn(clock.now())
    clock.sleep_until(clock.now() + 0.008)
    for k in range(4, 8):
        bench.stream("PSM1", *swing(start, k))
    bench.guard.turn(clock.now())  # takes 12 ms
    clock.sleep_until(clock.now() + PERIOD_S)
    bench.guard.turn(clock.now())
    assert bench.guard.gate.mode is Mode.RUNNING
    assert bench.guard.counts.stopped == 0


def test_an_arm_whose_program_falls_silent_is_not_waited_for_long(bench: Bench) -> None:
    bench.ready()
    start = {arm: bench.held(arm) for arm in ARMS}
    for k in range(1, 70):
        for arm in ARMS if k < 40 else ARMS[:1]:
            bench.stream(arm, *swing(start[arm], k, 0.05))
        bench.step()
    assert bench.guard.gate.mode is Mode.HOLDING
    assert bench.held("PSM2")[0] == pytest.approx(swing(start["PSM2"], 40, 0.05)[0][0], abs=5e-3)


def test_a_motion_that_ends_on_its_goal_has_not_broken_off(bench: Bench) -> None:
    bench.ready()
    start = bench.held("PSM1")
    for k in range(1, 201):
        x = k / 200
        way = 0.05 * x**3 * (10.0 - 15.0 * x + 6.0 * x * x)
        bench.stream("PSM1", [start[0] + way, *start[1:]])
        bench.step()
    bench.step(100)
    assert bench.guard.counts.stopped == 0
    assert bench.guard.gate.mode is Mode.RUNNING
    assert bench.held("PSM1")[0] == start[0] + 0.05


def test_a_setpoint_may_be_late_where_a_motion_turns_or_begins(bench: Bench) -> None:
    bench.ready()
    start = bench.held("PSM1")
    k = np.arange(402)
    ways = 0.03 * np.sin(pi * np.minimum(k, 100) / 200) ** 4 * np.sin(2.0 * pi * k / 133)
    turns = set(1 + np.flatnonzero(np.diff(np.sign(np.diff(ways[100:])))) + 100)
    assert len(turns) >= 4
    for k, way in enumerate(ways[1:], 1):
        if k in turns | {t + 1 for t in turns} | {8}:
            bench.step()
        bench.stream("PSM1", [start[0] + way, *start[1:]])
        bench.step()
    assert bench.guard.counts.stopped == 0


@pytest.mark.parametrize("wrong", [0.0, 28 * pi / 180])
def test_arms_are_disabled_however_long_a_cycle_takes(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, wrong: float
) -> None:
    bench.ready()
    start, clock, servo_jp = bench.held("PSM1"), bench.driver.clock, bench.driver.servo_jp

    def slow(setpoints: Sequence[JointSetpoint]) -> None:
        servo_jp(setpoints)
        clock.sleep_until(clock.now() + 1.5 * PERIOD_S)

    if wrong:
        bench.stream("PSM1", [start[0] + wrong, *start[1:]])
        bench.step(2)
    monkeypatch.setattr(bench.driver, "servo_jp", slow)
    bench.command("disable")
    bench.step(40)
    assert {arm.operating_state for arm in bench.driver.state().arms} == {"DISABLED"}
    assert bench.guard.gate.latched < Action.FAULT


def test_clients_and_people_hear_why_arms_are_stopped(bench: Bench) -> None:
    bench.ready()
    start = bench.held("PSM1")
    for k in range(1, 70):
        bench.stream("PSM1", *swing(start, k, 0.05))
        bench.step()
    bench.step(10)
    assert bench.said[-1] == "the client's stream has broken off"
    assert bench.errors[-1] == "PSM2: the client's stream has broken off"


def test_what_a_client_takes_back_is_taken_back(bench: Bench) -> None:
    """A hold of one arm does not undo that another was disabled; a pause holds arms at rest."""
    bench.ready()
    stamp = Header(Time.of_ns(bench.client.stamp_ns()))
    bench.out["PSM1/state_command"](StringStamped(stamp, "disable"))
    bench.out["PSM2/hold"](Empty())
    bench.step(40)
    assert {arm.operating_state for arm in bench.driver.state().arms} == {"DISABLED"}
    bench.ready()
    bench.command("pause")
    bench.step(20)
    assert bench.states["PSM1"].state == bench.states["PSM2"].state == "PAUSED"


@pytest.mark.parametrize("by", ["disable", "hold", "pause", "person"])
def test_homing_can_be_ended_and_is_told_of_meanwhile(
    bench: Bench, by: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.driver.say(consent=False)
    bench.step(3)
    bench.command("enable")
    bench.step(5)
    seen: list[OperatingState] = []
    meanwhile = bench.guard._attend

    def look() -> None:
        meanwhile()
        seen.append(bench.states["PSM1"])
        if len(seen) == 3 and by == "person":
            bench.guard.ask_to_stop()
        elif len(seen) == 3:
            bench.command(by)

    monkeypatch.setattr(bench.guard, "_attend", look)
    monkeypatch.setattr(bench.driver, "_is_reached", lambda wish: False)
    bench.command("home")
    monkeypatch.setattr(bench.driver, "_press", lambda: None)
    bench.guard.turn(bench.driver.clock.now())
    monkeypatch.undo()
    assert len(seen) == 3
    assert all(word.is_busy for word in seen)
    bench.step(20)
    assert any("homing was ended" in said for said in bench.errors)
    assert {arm.operating_state for arm in bench.driver.state().arms} == {"DISABLED"}


def test_a_client_hears_two_reasons_and_a_person_each_one_once(bench: Bench) -> None:
    for now in (10.0, 10.2, 10.4):
        bench.guard._telling.reason("PSM1 has no instrument", now)
    bench.guard._telling.reason("a teleoperation commands PSM1", 10.6)
    assert [text for text in bench.errors if text.startswith("PSM1")] == [
        "PSM1: PSM1 has no instrument",
        "PSM1: a teleoperation commands PSM1",
    ]
    assert bench.said == ["PSM1 has no instrument", "a teleoperation commands PSM1"]


def test_a_pedal_that_was_seen_let_go_counts_however_late_the_setpoint_is(bench: Bench) -> None:
    bench.ready()
    start, clock = bench.held("PSM1"), bench.driver.clock
    clock.sleep_until(bench.guard._last_s + PERIOD_S)
    bench.stream("PSM1", *swing(start, 1))
    due = bench.guard.turn(clock.now())
    bench.driver.say(consent=False)
    clock.sleep_until(due)
    bench.guard.turn(clock.now())
    bench.driver.say(consent=True)
    clock.sleep_until(clock.now() + PERIOD_S)
    bench.stream("PSM1", *swing(start, 2))
    bench.guard.turn(clock.now())
    assert bench.guard.gate.mode is Mode.HOLDING


def test_a_hold_is_acted_on_within_a_period_when_the_stream_ends_with_it(bench: Bench) -> None:
    bench.ready()
    start, clock = bench.held("PSM1"), bench.driver.clock
    for k in range(1, 60):
        bench.stream("PSM1", *swing(start, k, 0.05))
        bench.step()
    bench.out["PSM1/hold"](Empty())
    now = clock.now()
    assert bench.guard.turn(now) <= bench.guard._last_s + PERIOD_S + 1e-9
    bench.step()
    assert bench.guard.gate.mode is Mode.HOLDING


def test_a_client_at_a_limit_is_not_told_of_it_all_the_time(bench: Bench) -> None:
    (arm, _), bench.warnings[:] = bench.guard.arms, []
    for now in (1.0, 1.1, 1.4, 1.6):
        arm.tell("gate running: joint speed (S05): SCALE", True, now)
    assert bench.warnings == ["PSM1: gate running: joint speed (S05): SCALE"] * 2


def test_all_that_dvrks_client_wants_is_there(bench: Bench) -> None:
    client = Inproc(bench.driver.exchange)
    for topic in ARM:
        name = f"/guarded/PSM1/{topic.name}"
        if topic.publisher == "server":
            client.subscribe(name, topic.message, lambda *_: None)
        else:
            client.publisher(name, topic.message)
        assert client.peers(name) > 0, name


def test_every_cycle_and_every_verdict_is_recorded(bench: Bench, tmp_path: Path) -> None:
    with Recorder(tmp_path / "recording", CELL, PERIOD_S) as recorder:
        recorder.wait_until_open()
        bench.guard._recorder = recorder
        bench.ready()
        start = bench.held("PSM1")
        for k in range(1, 21):
            bench.stream("PSM1", *swing(start, k))
            bench.step()
        bench.stream("PSM1", [nan, *start[1:]])
        bench.step(40)
    recording = read_recording(tmp_path / "recording")
    assert recording.complete
    held = recording.joints["/PSM1/setpoint_js"].position
    for k in range(1, 21):
        assert (held[:, 0] == swing(start, k)[0][0]).any(), "as the client has sent it"
    assert np.isfinite(held).all()
    verdicts = {(row.rule, row.action) for row in recording.verdicts}
    assert ("S01", Action.FAULT) in verdicts


def test_a_step_of_28_degrees_is_held_until_a_person_clears_it(bench: Bench) -> None:
    bench.ready()
    start = bench.held("PSM1")
    bench.stream("PSM1", [start[0] + 28 * pi / 180, *start[1:]])
    bench.step(80)
    assert bench.guard.gate.mode is Mode.HOLDING
    assert bench.states["PSM1"].state == bench.states["PSM2"].state == "PAUSED"
    assert bench.held("PSM1") == pytest.approx(start, abs=1e-4)
    assert any("tip speed (S10): STOP" in said for said in bench.warnings), bench.warnings
    assert {said[:4] for said in bench.warnings} == set(ARMS)
    bench.agree()
    bench.step(50)
    assert bench.guard.gate.mode is Mode.HOLDING, "its tip would have moved too fast: S10 ends runs"
    bench.guard.is_reset_wanted = True
    bench.step(2)
    bench.agree()
    assert bench.guard.gate.mode in GOING


def test_a_hold_goes_on_when_the_operator_presses_the_pedal_anew(bench: Bench) -> None:
    bench.ready()
    start = bench.held("PSM1")
    bench.stream("PSM1", [*start[:3], start[3] + 0.3, *start[4:]])
    bench.step(80)
    assert bench.guard.gate.mode is Mode.HOLDING
    bench.command("resume")
    bench.step(5)
    assert "pedal" in bench.errors[-1]
    assert bench.guard.gate.mode is Mode.HOLDING, "a program does not clear a hold"
    bench.agree()
    bench.step(50)
    assert bench.guard.gate.mode is Mode.RUNNING
    assert bench.statuses[-1] == "PSM2: gate running"
    bench.received.clear()
    for k in range(1, 20):
        bench.stream("PSM1", *swing(start, k))
        bench.step()
    assert bench.guard.gate.mode is Mode.RUNNING
    assert list(bench.received["PSM1/servo_jp"][-1].position) == swing(start, 19)[0]


def test_a_nan_is_refused_and_only_a_person_clears_it(bench: Bench) -> None:
    bench.ready()
    start = bench.held("PSM1")
    bench.stream("PSM1", [nan, *start[1:]])
    bench.step(40)
    assert bench.guard.gate.mode is Mode.FAULT
    assert bench.states["PSM1"].state == "FAULT"
    numbers = [x for words in bench.received.values() for word in words for x in word.position]
    assert np.isfinite(numbers).all()
    bench.agree()
    assert bench.guard.gate.mode is Mode.FAULT
    bench.guard.is_reset_wanted = True
    bench.step(2)
    bench.agree()
    assert bench.guard.gate.mode in GOING
    bench.told.clear()
    bench.stream("PSM1", [nan, *start[1:]])
    bench.step(2)
    assert any("S01" in rules for rules, _ in bench.told), "people are told of every fault anew"


@pytest.mark.parametrize("wrong", [nan, 28 * pi / 180])
def test_a_client_that_disables_the_arms_clears_no_stop_and_no_fault(
    bench: Bench, wrong: float
) -> None:
    bench.ready()
    start = bench.held("PSM1")
    bench.stream("PSM1", [start[0] + wrong, *start[1:]])
    bench.step(80)
    latched = bench.guard.gate.latched
    bench.command("disable")
    bench.step(10)
    assert {arm.operating_state for arm in bench.driver.state().arms} == {"DISABLED"}
    assert bench.states["PSM1"].state == "DISABLED", "as the client waits for"
    for word in ("enable", "home"):
        bench.command(word)
        bench.step(50)
    assert any('type "reset" at the guard' in said for said in bench.errors)
    assert {arm.operating_state for arm in bench.driver.state().arms} == {"DISABLED"}
    assert bench.guard.gate.latched is latched
    bench.guard.is_reset_wanted = True
    bench.step(2)
    bench.ready()


def test_a_client_that_dies_in_mid_motion_is_stopped_within_100_ms(bench: Bench) -> None:
    bench.ready()
    start = bench.held("PSM1")
    for k in range(1, 70):
        bench.stream("PSM1", *swing(start, k, 0.05))
        bench.step()
    moving = bench.guard.counts.passed
    assert bench.guard.gate.mode is Mode.RUNNING
    bench.step(int(0.1 / PERIOD_S))
    assert bench.guard.gate.mode is Mode.HOLDING
    assert bench.guard.counts.passed == moving
    assert any("S16" in rules for rules, _ in bench.told)
    bench.step(40)
    before = bench.held("PSM1")
    bench.step(20)
    assert bench.held("PSM1") == before


def test_a_client_that_pauses_at_rest_is_not_held(bench: Bench) -> None:
    bench.ready()
    start = bench.held("PSM1")
    for k in range(1, 201):
        bench.stream("PSM1", *swing(start, k))
        bench.step()
    bench.step(200)
    assert bench.guard.gate.mode is Mode.RUNNING
    for k in range(1, 101):
        bench.stream("PSM1", *swing(start, k))
        bench.step()
    assert bench.guard.counts.stopped == 0


def test_setpoints_lost_on_the_way_are_judged_by_what_lay_between(bench: Bench) -> None:
    bench.ready()
    start = bench.held("PSM1")
    bench.received.clear()
    for k in range(1, 201):
        if k % 17 not in (3, 4):
            bench.stream("PSM1", *swing(start, k, 0.02))
        bench.step()
    assert bench.guard.counts.stopped == 0
    assert bench.guard.counts.filled >= 20  # of 24: the gate lets the others pass as they come
    lost = sum(k % 17 in (3, 4) for k in range(1, 201))
    assert len(bench.received["PSM1/servo_jp"]) >= 200 - lost, "what was lost is not sent"


def test_a_client_that_wakes_late_and_stamps_it_goes_no_farther_for_that(bench: Bench) -> None:
    bench.ready()
    start, now = bench.held("PSM1"), bench.client.stamp_ns
    late_ns = iter([0, 0, 6_000_000, 0] * 50)
    bench.client.stamp_ns = lambda: now() + next(late_ns)  # type: ignore[method-assign]
    for k in range(1, 201):
        bench.stream("PSM1", *swing(start, k, 0.02))
        bench.step()
    assert (bench.guard.counts.stopped, bench.guard.counts.filled) == (0, 0)


def test_a_jaw_may_be_streamed_less_often_than_its_arm(bench: Bench) -> None:
    bench.ready()
    start, jaw = bench.held("PSM1"), bench.driver.state().arms[0].jaw_setpoint_jp
    for k in range(1, 201):
        bench.stream("PSM1", *swing(start, k))
        if k % 4 == 0:
            bench.stream("PSM1", [jaw], [0.0], "jaw/")
        bench.step()
    assert bench.guard.counts.stopped == 0


def test_poses_pass_as_joints(bench: Bench) -> None:
    bench.ready()
    bench.step(5)
    goal = bench.poses["PSM1"]
    before = bench.held("PSM1")
    for _ in range(20):
        bench.out["PSM1/servo_cp"](
            PoseStamped(Header(Time.of_ns(bench.client.stamp_ns())), goal.pose)
        )
        bench.step()
    assert bench.guard.gate.mode is Mode.RUNNING
    assert bench.held("PSM1") == pytest.approx(before, abs=1e-3)


def moved(cell: CellDescription) -> CellDescription:
    """The cell as a calibration has it that found its arms 4 mm to the side."""
    file = calibration_of(cell)
    arms = []
    for arm in file.arms:
        T = np.array(arm.T_task_base)
        T[:3, 3] += SIDEWAYS
        arms.append(arm.model_copy(update={"T_task_base": T.tolist()}))
    return calibrated(cell, file.model_copy(update={"arms": tuple(arms)}), Path("lab.json"))


@pytest.mark.parametrize("bench", [moved(CELL)], indirect=True)
def test_poses_and_the_gate_follow_the_calibration(bench: Bench) -> None:
    bench.ready()
    bench.step(5)
    state, here = bench.driver.state(), bench.poses["PSM1"].pose.position
    nominal = CellLinks(CELL).tips([arm.measured_jp for arm in state.arms])[0][:3, 3]
    assert (here.x, here.y, here.z) == pytest.approx(nominal + SIDEWAYS, abs=1e-4)
    before = bench.held("PSM1")
    head = Header(Time.of_ns(bench.client.stamp_ns()))
    bench.out["PSM1/servo_cp"](PoseStamped(head, bench.poses["PSM1"].pose))
    bench.step(3)
    assert bench.held("PSM1") == pytest.approx(before, abs=1e-3), "it is asked to stay"
    chain = bench.guard.gate.envelope.arms[0].chain
    point = chain.points(state.arms[0].measured_jp)[0]
    assert point == pytest.approx(nominal + SIDEWAYS, abs=1e-9), "the gate's, too"


def test_what_the_guard_does_not_pass_is_refused_in_words(bench: Bench) -> None:
    bench.ready()
    bench.out["PSM1/move_jp"](JointState(position=bench.held("PSM1")))
    bench.step(2)
    assert "move_jp does not pass the guard" in bench.errors[-1]
    bench.step(500)
    bench.stream("PSM1", bench.held("PSM1")[:5])
    bench.step(2)
    assert "5 positions" in bench.errors[-1]
    assert bench.guard.gate.mode in GOING


def test_consent_that_is_withdrawn_holds_and_disable_takes_the_power(bench: Bench) -> None:
    bench.ready()
    start = bench.held("PSM1")
    for k in range(1, 30):
        bench.stream("PSM1", *swing(start, k))
        bench.step()
    bench.driver.say(consent=False)
    for k in range(30, 60):
        bench.stream("PSM1", *swing(start, k))
        bench.step()
    assert bench.guard.gate.mode is Mode.HOLDING
    bench.command("disable")
    bench.step(80)
    assert {arm.operating_state for arm in bench.driver.state().arms} == {"DISABLED"}
    assert bench.states["PSM1"].state == "DISABLED"
    bench.ready()


def test_disabling_in_mid_motion_stops_the_arms_first(bench: Bench) -> None:
    bench.ready()
    start = bench.held("PSM1")
    for k in range(1, 70):
        bench.stream("PSM1", *swing(start, k, 0.05))
        bench.step()
    bench.received.clear()
    bench.command("disable")
    bench.step(100)
    q = [word.position[0] for word in bench.received["PSM1/servo_jp"]]
    assert len(q) > 5, "the gate's own stop was sent"
    assert abs(q[-1] - q[-2]) < 1e-9
    assert bench.driver.state().arms[0].operating_state == "DISABLED"


def test_another_program_beside_the_guard_ends_the_run(bench: Bench) -> None:
    bench.ready()
    start = bench.held("PSM1")
    other = Inproc(bench.driver.exchange).publisher("/PSM1/servo_jp", JointState)
    for k in range(1, 60):
        bench.stream("PSM1", *swing(start, k))
        bench.guard.turn(bench.driver.clock.now())
        if k > 20:
            other(JointState(position=(start[0] + 0.05, *start[1:]), velocity=(0.0,) * 6))
        bench.driver.clock.sleep_until(bench.driver.clock.now() + PERIOD_S)
    assert bench.guard.gate.mode is Mode.FAULT
    assert any("S24" in rules for rules, _ in bench.told)


def test_old_state_commands_of_a_client_are_not_obeyed(bench: Bench) -> None:
    stamp = Time.of_ns(bench.client.stamp_ns() - 10_000_000_000)
    bench.out["PSM1/state_command"](StringStamped(Header(stamp), "enable"))
    bench.step(5)
    assert bench.states["PSM1"].state == "DISABLED"
    assert "send it again" in bench.errors[-1]
