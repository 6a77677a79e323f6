"""A bundle on a robot, in stages; the robot is the stepped loopback, a person stands by."""

import math
import os
import signal
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lab_files import SCENE
from operators import Person, Spied
from silent_recorder import SilentRecorder

from viskill_deploy.cli.execute import _judge
from viskill_deploy.core.errors import DriverError, Interrupted, SafetyStop
from viskill_deploy.core.scene_files import read_scene
from viskill_deploy.core.types import JointSetpoint
from viskill_deploy.drivers.crtk.server_options import ServerOptions
from viskill_deploy.drivers.crtk.simulated import SteppedCrtk
from viskill_deploy.motion.resolve import waypoint_at
from viskill_deploy.motion.waypoints import start_waypoint
from viskill_deploy.runtime.execution import ExecuteOptions, execute, look_before
from viskill_deploy.runtime.figures import Outcome
from viskill_deploy.runtime.poses import FILED, FiledPoses, PoseLimits, Sighting, Things
from viskill_deploy.runtime.preflight import Prepared, prepare
from viskill_deploy.sim.world import WorldOptions

ROOT = Path(__file__).resolve().parents[2]
BUNDLE = ROOT / "policies/bipegtransfer-viskill"
DEEP = 0.12
"""Insertion to which a dVRK homes its simulated arms."""


@pytest.fixture(scope="module")
def prepared() -> Prepared:
    return prepare(BUNDLE)


class Kept(SilentRecorder):
    """Keeps what the gate let out."""

    def __init__(self) -> None:
        self.passed: list[tuple[JointSetpoint, ...]] = []
        self.began = -1

    def cycle(self, *record: Any) -> None:
        self.passed.append(record[3])

    def mark(self, *record: Any, **named: Any) -> None:
        self.began = len(self.passed) if self.began < 0 else self.began


@dataclass
class Ran:
    """A run that is over."""

    outcome: Outcome
    driver: Spied
    person: Person
    passed: list[tuple[JointSetpoint, ...]]
    began: int

    @property
    def result(self) -> dict[str, Any]:
        return self.outcome.figures["episode_results"][0]

    def tips(self, prepared: Prepared) -> np.ndarray:
        """Where the gate let the tips go after the approach, real task frame, (n, arms, 3)."""
        rows = [[(*s.jp, s.jaw) for s in row] for row in self.passed[self.began :]]
        waypoints = [waypoint_at(prepared.cell, row) for row in rows[::5]]
        return np.array([[T[:3, 3] for T in w.T_task_tip] for w in waypoints])


def robot(prepared: Prepared) -> Spied:
    driver = Spied(prepared.cell)
    driver.connect()
    rng = np.random.default_rng(5)
    driver.reset(prepared.task.sample_layout(rng, "reference"))
    return driver


def put_arms_where_a_dvrk_homes(driver: Spied) -> None:
    axes = np.zeros((len(driver.world.cell.arms), 7))
    axes[:, 2] = DEEP
    driver.world.place(driver.world.scene(), axes)
    setpoints = [JointSetpoint(tuple(r[:6]), (0.0,) * 6, r[6], 0.0) for r in axes.tolist()]
    driver.cell.restore(driver.world.save(), setpoints)


def ran(
    prepared: Prepared,
    driver: Spied,
    person: Person | None = None,
    things: Things | None = None,
    **how: Any,
) -> Ran:
    person = person or Person()
    options = ExecuteOptions(**({"speed": 1.0} | how))
    recorder = Kept()
    outcome = execute(prepared, options, driver, recorder, person, things)
    return Ran(outcome, driver, person, recorder.passed, recorder.began)


def is_at_start(prepared: Prepared, sent: Sequence[JointSetpoint]) -> bool:
    start = start_waypoint(prepared.cell)
    here = waypoint_at(prepared.cell, [(*s.jp, s.jaw) for s in sent])
    pairs = zip(here.T_task_tip, start.T_task_tip, strict=True)
    return all(np.abs(a - b).max() < 1e-3 for a, b in pairs)


@pytest.fixture(scope="module")
def held_and_resumed(prepared: Prepared, tmp_path_factory: pytest.TempPathFactory) -> Ran:
    """From where a dVRK homes, with a scene file; consent is lost for a second while it grasps."""
    file = tmp_path_factory.mktemp("scene") / "scene.toml"
    file.write_text(SCENE, encoding="utf-8")
    seen = read_scene(file, "bipegtransfer")
    driver = robot(prepared)
    driver.reset(seen.scene)
    put_arms_where_a_dvrk_homes(driver)
    person = Person(thinks=120)
    driver.events = [
        (500, partial(driver.say, consent=False)),
        (600, partial(driver.say, consent=True)),
    ]
    things = Things(seen.scene, FiledPoses(seen), FILED, ["PSM1", "PSM2"])
    return ran(prepared, driver, person, things)


def test_a_run_goes_on_after_consent_was_lost_and_given_back_and_does_its_task(
    held_and_resumed: Ran,
) -> None:
    run = held_and_resumed
    assert run.outcome.failure is None
    assert run.result["resumed"] == ["S22"]
    assert run.result["success"]
    assert run.outcome.figures["judged"]
    assert run.outcome.figures["interventions"] == 0
    assert len(run.person.asked) == 1
    assert "held (S22" in run.person.asked[0]


def test_the_arms_are_fetched_from_where_they_are_and_brought_back_and_switched_off(
    held_and_resumed: Ran, prepared: Prepared
) -> None:
    run = held_and_resumed
    assert run.driver.sent[0][0].jp[2] == pytest.approx(DEEP, abs=1e-3)
    assert is_at_start(prepared, run.driver.sent[-1])
    assert max(map(abs, run.driver.sent[-1][0].jv)) < 1e-6
    assert run.driver.calls[-1] == "close"
    assert run.driver.calls.index("enable") < run.driver.calls.index("home")


def test_every_motion_asks_for_the_pedal_anew(held_and_resumed: Ran) -> None:
    pressed = [note for note in held_and_resumed.person.told if "press the consent pedal" in note]
    assert len(pressed) == 2, "the approach and the run"


def test_a_thing_that_nobody_sees_is_taken_to_go_with_the_jaw_and_that_is_noted(
    held_and_resumed: Ran,
) -> None:
    notes = held_and_resumed.outcome.figures["notes"]
    assert any("block1 was not seen in PSM2's jaw" in note for note in notes)


@pytest.fixture(scope="module")
def rehearsed(prepared: Prepared) -> Ran:
    return ran(prepared, robot(prepared), is_rehearsal=True)


def test_a_rehearsal_judges_every_setpoint_and_sends_nothing(
    rehearsed: Ran, prepared: Prepared
) -> None:
    run, driver = rehearsed, rehearsed.driver
    assert run.outcome.failure is None
    assert run.result["refused"] == ""
    assert [skill["name"] for skill in run.result["skills"]] == ["grasp", "handover", "release"]
    assert run.outcome.figures["setpoints"] > 2000
    assert driver.sent == []
    assert driver.calls == ["close"]
    assert run.outcome.figures["judged"] is False
    assert driver.readings > 1000
    untouched = robot(prepared).world
    untouched.step([JointSetpoint(tuple(r[:6]), (0.0,) * 6, r[6], 0.0) for r in untouched.home])
    for arm in range(2):
        found, was = driver.world.measured(arm).jp, untouched.measured(arm).jp
        np.testing.assert_allclose(found, was, atol=1e-3)
    assert "PSM1 is not homed: taken to be in its start pose" in run.outcome.figures["notes"]


def test_in_the_air_every_tip_is_higher_by_the_lift_and_never_lower(
    rehearsed: Ran, prepared: Prepared
) -> None:
    air = ran(prepared, robot(prepared), lift_m=0.03)
    assert air.outcome.failure is None
    assert air.result["refused"] == ""
    low, high = (run.tips(prepared)[..., 2] for run in (rehearsed, air))
    np.testing.assert_allclose(high.min(axis=0) - low.min(axis=0), 0.03, atol=3e-4)
    np.testing.assert_allclose(high.max(axis=0) - low.max(axis=0), 0.03, atol=3e-4)
    way_up = [s.jp[2] for s, _ in air.passed[: air.began]]
    assert len(way_up) > 50
    assert np.diff(way_up).max() < 1e-9, "the way up is a way out"
    assert len(air.driver.sent) == len(air.passed)
    jaws = [setpoint.jaw for row in air.driver.sent for setpoint in row]
    assert max(jaws) - min(jaws) > 0.3, "the jaws move"


def test_the_operator_is_asked_before_every_skill_and_may_end_the_run(prepared: Prepared) -> None:
    person = Person(answers=["", "n"])
    run = ran(prepared, robot(prepared), person, mode="closed-loop", stops="skill")
    assert [q.split(",")[0] for q in person.asked[:2]] == ["next: grasp", "next: handover"]
    assert [skill["name"] for skill in run.result["skills"]] == ["grasp"]
    assert isinstance(run.outcome.failure, Interrupted)
    assert run.result["reason"] == "the operator ended the run"
    assert max(map(abs, run.driver.sent[-1][1].jv)) < 1e-6


def test_ctrl_c_brings_the_arms_to_rest_and_takes_their_power(prepared: Prepared) -> None:
    driver = robot(prepared)
    driver.events = [(150, partial(os.kill, os.getpid(), signal.SIGINT))]
    run = ran(prepared, driver, mode="closed-loop")
    assert isinstance(run.outcome.failure, Interrupted)
    assert 150 < len(driver.sent) < 250
    assert max(abs(v) for s in driver.sent[-1] for v in s.jv) < 1e-6
    assert run.person.asked == [], "nobody is asked to resume what a person has ended"
    assert driver.calls[-1] == "close"


def test_a_run_is_not_resumed_after_a_fault(prepared: Prepared) -> None:
    driver = robot(prepared)

    def fail() -> None:
        raise DriverError("the cable is out")

    driver.events = [(150, fail)]
    run = ran(prepared, driver, mode="closed-loop")
    assert run.result["stopped_by"] == "S24"
    assert run.result["resumed"] == []
    assert run.person.asked == []


def test_a_hold_that_became_a_stop_is_not_resumed(prepared: Prepared) -> None:
    driver, person = robot(prepared), Person(thinks=1000)
    driver.events = [(150, partial(driver.say, consent=False))]
    run = ran(prepared, driver, person, mode="closed-loop")
    assert run.result["stopped_by"] == "S22"
    assert run.result["resumed"] == []
    assert person.told[-1] == "not resumed: the run ends here"


class Tracker:
    """Sees a thing until somebody stands in the way."""

    def __init__(self, driver: Spied, name: str) -> None:
        self._driver, self._name, self.blind_after = driver, name, math.inf
        self._last: Sighting | None = None

    def newest(self, name: str) -> Sighting | None:
        assert name == self._name
        if len(self._driver.sent) <= self.blind_after:
            pose = self._driver.world.scene().pose(name)
            self._last = Sighting(pose, self._driver.clock.now(), 0.0005)
        return self._last

    def close(self) -> None:
        pass


def test_a_thing_that_is_not_seen_any_more_holds_the_arms_and_is_named(
    prepared: Prepared,
) -> None:
    driver, person = robot(prepared), Person(answers=["n"])
    scene = driver.scene()
    (active,) = [thing for thing in scene.objects if thing.name == scene.active]
    tracker = Tracker(driver, active.name)
    tracker.blind_after = 100
    seen = replace(scene, objects=(active,))
    things = Things(seen, tracker, PoseLimits(age_s=0.3), ["PSM1", "PSM2"])
    run = ran(prepared, driver, person, things, mode="closed-loop")
    assert run.result["stopped_by"] == "S16"
    assert f"{active.name} was not seen for 0.3" in run.result["reason"]
    assert 125 <= len(driver.sent) <= 200
    assert len(person.asked) == 1, "it is a HOLD: a person may resume when it is seen again"


def test_the_preflight_looks_at_files_robot_scene_and_plan_and_sends_nothing(
    prepared: Prepared,
) -> None:
    driver = robot(prepared)
    checklist = look_before(prepared, ExecuteOptions(speed=1.0, lift_m=0.03), driver)
    assert checklist.error is None
    names = [line.name for line in checklist.lines]
    assert names[4:12] == [
        "cell", "arms", "instruments", "power", "consent", "things", "start pose", "scene",
    ]  # fmt: skip
    assert "will be enabled and homed" in next(
        line.text for line in checklist.lines if line.name == "power"
    )
    assert driver.sent == []
    assert driver.calls == []


def test_arms_that_speak_crtk_are_homed_fetched_run_and_switched_off(prepared: Prepared) -> None:
    driver = SteppedCrtk(prepared.cell, WorldOptions(0.01), server=ServerOptions(homing="dvrk"))
    driver.connect()
    driver.reset(prepared.task.sample_layout(np.random.default_rng(5), "reference"))
    before = look_before(prepared, ExecuteOptions(speed=1.0), driver)
    assert before.error is None
    recorder, person = Kept(), Person()
    outcome = execute(prepared, ExecuteOptions(speed=1.0), driver, recorder, person)
    assert outcome.failure is None
    (result,) = outcome.figures["episode_results"]
    assert result["refused"] == result["stopped_by"] == ""
    assert result["success"]
    assert recorder.passed[0][0].jp[2] == pytest.approx(DEEP, abs=2e-3), "where a dVRK homes"
    assert is_at_start(prepared, recorder.passed[-1])


def test_a_fault_of_an_arm_ends_the_run_and_stays_for_a_person_to_clear(
    prepared: Prepared, tmp_path: Path
) -> None:
    driver = SteppedCrtk(prepared.cell, WorldOptions(0.01))
    driver.connect()
    driver.reset(prepared.task.sample_layout(np.random.default_rng(5), "reference"))
    recorder, person = Kept(), Person()
    cycle = recorder.cycle

    def fault_in_time(*record: Any) -> None:
        cycle(*record)
        if len(recorder.passed) == 200:
            driver.front.cause("tracking", "PSM1", True)

    recorder.cycle = fault_in_time  # type: ignore[method-assign]
    outcome = execute(
        prepared, ExecuteOptions(speed=1.0, mode="closed-loop"), driver, recorder, person
    )
    (result,) = outcome.figures["episode_results"]
    assert result["stopped_by"] == "S23"
    assert "PSM1 is in FAULT (PSM1: tracking error" in result["reason"]
    assert person.asked == [], "nobody is asked to resume it"
    assert len(recorder.passed) < 260
    states = {name: arm.arm.operating.state for name, arm in driver.front.arms.items()}
    assert states == {"PSM1": "FAULT", "PSM2": "DISABLED"}
    with pytest.raises(SafetyStop, match=r"a person has to look at it.*--recover"):
        _judge(outcome.figures, outcome.failure, tmp_path / "report.html")
