"""Measurements are taken through the gate, and none is lost."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from operators import Person
from silent_recorder import SilentRecorder

from viskill_deploy.calibrate.books import Book
from viskill_deploy.calibrate.collect import Collected, collect
from viskill_deploy.calibrate.error_model import ErrorModel
from viskill_deploy.calibrate.measurements import load
from viskill_deploy.calibrate.parameters import DELAY, NAMES
from viskill_deploy.calibrate.programme import choose_poses
from viskill_deploy.core.arm_errors import ArmErrors, with_errors
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import CalibrationError, Interrupted, SafetyStop
from viskill_deploy.core.types import FloatArray
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.kinematics.closed_form import inverse_batch
from viskill_deploy.motion.resolve import base_poses, task_poses
from viskill_deploy.motion.waypoints import start_waypoint
from viskill_deploy.runtime.consent import PersonsConsent
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.session import Session
from viskill_deploy.sim.tasks.base import load_task
from viskill_deploy.sim.tracker import SimulatedTracker, TrackerOptions
from viskill_deploy.sim.world import WorldOptions

CELL = load_cell("bipegtransfer")
COUNT = 10
PERIOD_S = 0.01
POSES = np.stack([choose_poses(CELL, arm, COUNT, seed=0) for arm in range(2)], axis=1)
CLEAN = TrackerOptions(noise_m=0.0, outlier_share=0.0)


class Interrupting(SimulatedTracker):
    """Fails at a look, as a cable that is pulled would."""

    left = 10**9

    def look(self, now: float) -> None:
        super().look(now)
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt


def _collect(
    folder: Path,
    looks: int = 10**9,
    options: TrackerOptions = CLEAN,
    truth: tuple[ArmErrors, ...] = (),
    poses: FloatArray = POSES,
    programme: str = "seed 0",
) -> Collected:
    driver = LoopbackDriver(CELL, WorldOptions(PERIOD_S, truth=truth))
    driver.connect()
    driver.reset(load_task("bipegtransfer").sample_layout(np.random.default_rng(0), "reference"))
    source = Interrupting(driver.world, options)
    source.left = looks
    line = Line(CELL, driver.period_s)
    with Session(CELL, driver, line, SilentRecorder()) as session:
        return collect(session, source, poses, folder, programme)


def test_what_is_measured_is_where_the_arms_are(tmp_path: Path) -> None:
    truth = (ArmErrors(base_translation_m=(0.003, 0.0, -0.002)), ArmErrors())
    found = _collect(tmp_path, truth=truth)
    assert (found.measured, found.skipped) == (COUNT, 0)
    really = with_errors(CELL, {"PSM1": truth[0]})
    for index, path in enumerate(found.files.values()):
        m = load(path)
        is_moving = m.speeds.any(axis=1)
        assert (~is_moving).sum() == COUNT
        assert is_moving.sum() == 5
        there = task_poses(really, index, m.joints)[:, :3, 3]
        np.testing.assert_allclose(m.points, there, atol=2e-5)
        assert set(np.unique(m.turns)) <= {-1.0, 0.0, 1.0}
        assert (m.turns[1:] != 0.0).mean() > 0.9


def test_a_marker_beyond_the_jaw_pivot_is_measured_and_said_so(tmp_path: Path) -> None:
    truth = (ArmErrors(joint_offset=(0.0, 0.0, 0.0, 0.0, 0.0, 0.05)), ArmErrors())
    found = _collect(tmp_path, truth=truth, options=replace(CLEAN, point_m=0.01))
    really = with_errors(CELL, {"PSM1": truth[0]})
    m = load(found.files["PSM1"])
    assert m.point_m == 0.01
    T = task_poses(really, 0, m.joints)
    there = T[:, :3, 3] + 0.01 * T[:, :3, 2]
    np.testing.assert_allclose(m.points, there, atol=3e-5)
    by_file = task_poses(CELL, 0, m.joints)
    off = np.linalg.norm(by_file[:, :3, 3] + 0.01 * by_file[:, :3, 2] - m.points, axis=1)
    assert off.min() > 3e-4, "it shows how the jaw is turned about its pivot"


def test_the_delay_of_a_tracker_shows_on_the_move_alone(tmp_path: Path) -> None:
    found = _collect(tmp_path, options=TrackerOptions(0.0, 0.0, 0.02, (0.03, 0.03)))
    m = load(found.files["PSM1"])
    is_moving = m.speeds.any(axis=1)
    off = np.linalg.norm(m.points - task_poses(CELL, 0, m.joints)[:, :3, 3], axis=1)
    assert off[~is_moving].max() < 2e-5
    assert off[is_moving].min() > 2e-4
    vector = np.zeros(len(NAMES))
    vector[DELAY] = 0.03
    late = ErrorModel(CELL.arms[0]).points(vector, m)
    np.testing.assert_allclose(m.points, late, atol=3e-5)


@pytest.mark.parametrize("part", [0, 20, 200])
def test_a_file_that_ended_within_its_first_lines_is_begun_again(part: int, tmp_path: Path) -> None:
    path, arm = tmp_path / "PSM1.csv", CELL.arms[0]
    Book(path, "seed 0", arm, 0.0).close()
    whole = path.read_text()
    path.write_text(whole[:part])
    Book(path, "seed 0", arm, 0.0).close()
    assert path.read_text() == whole
    path.write_text(whole.replace(",a1_rad_s2", ""))
    with pytest.raises(CalibrationError, match="version of this program"):
        Book(path, "seed 0", arm, 0.0)


def test_a_collection_that_was_cut_off_goes_on_where_it_was(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        _collect(tmp_path, looks=650)
    text = (tmp_path / "PSM1.csv").read_text()
    kept = text[: text.rfind(" done\n") + 6]
    assert 2 <= kept.count(" done\n") < COUNT
    with (tmp_path / "PSM1.csv").open("a") as file:
        file.write("0.1,0.2")  # a row that was being written
    found = _collect(tmp_path)
    assert (~load(found.files["PSM1"]).speeds.any(axis=1)).sum() == COUNT
    assert found.files["PSM1"].read_text().startswith(kept)


def test_a_folder_of_another_programme_is_refused(tmp_path: Path) -> None:
    _collect(tmp_path, poses=POSES[:2])
    with pytest.raises(CalibrationError, match="another programme"):
        _collect(tmp_path, programme="seed 1")


def test_poses_that_the_gate_would_refuse_are_left_out(tmp_path: Path) -> None:
    poses = POSES[:3].copy()
    poses[1, 0, 2] = 0.235  # far below the floor
    found = _collect(tmp_path, poses=poses)
    assert (found.measured, found.skipped) == (2, 1)


def test_a_pose_that_an_arm_cannot_get_to_is_not_tried_again(tmp_path: Path) -> None:
    low = np.array(start_waypoint(CELL).T_task_tip)[:1]
    low[0, :3, 3] = (0.02, 0.03, 0.012)  # above the board where the file has the arm; it is lower
    poses = POSES[:4].copy()
    seed = poses[1, 0]
    poses[1, 0] = inverse_batch(CELL.arms[0].arm, base_poses(CELL, 0, low), seed)[0][0]
    sunk = (ArmErrors(base_translation_m=(0.0, 0.0, -0.012)), ArmErrors())
    with pytest.raises(SafetyStop, match="S17"):
        _collect(tmp_path, truth=sunk, poses=poses)
    assert (tmp_path / "PSM1.csv").read_text().endswith("# pose 1 given up\n")
    found = _collect(tmp_path, truth=sunk, poses=poses)
    assert (found.measured, found.skipped) == (3, 1)
    assert (~load(found.files["PSM1"]).speeds.any(axis=1)).sum() == 3


@pytest.mark.parametrize("who", ["gate", "person"])
def test_what_was_measured_stays_when_it_is_ended(who: str, tmp_path: Path) -> None:
    driver = LoopbackDriver(CELL, WorldOptions(PERIOD_S))
    driver.connect()
    driver.reset(load_task("bipegtransfer").sample_layout(np.random.default_rng(0), "reference"))

    class Ending(SimulatedTracker):
        looks = 0

        def look(self, now: float) -> None:
            super().look(now)
            self.looks += 1
            if self.looks == 480 and who == "gate":
                driver.say(estop=True)
            elif self.looks == 480:
                session.ask_to_stop()

    line = Line(CELL, driver.period_s)
    expected = {"gate": (SafetyStop, "S23"), "person": (Interrupted, "start again to go on")}[who]
    with Session(CELL, driver, line, SilentRecorder()) as session:
        source = Ending(driver.world, CLEAN)
        with pytest.raises(expected[0], match=expected[1]):
            collect(session, source, POSES, tmp_path, "seed 0")
    assert len(load(tmp_path / "PSM1.csv")) >= 2


def test_arms_do_not_go_on_where_nobody_sees_them(tmp_path: Path) -> None:
    driver = LoopbackDriver(CELL, WorldOptions(PERIOD_S))
    driver.connect()
    driver.reset(load_task("bipegtransfer").sample_layout(np.random.default_rng(0), "reference"))

    class Covered(SimulatedTracker):
        def points(self, now: float) -> dict[str, tuple[float, FloatArray]]:
            return {name: seen for name, seen in super().points(now).items() if name == "PSM1"}

    line = Line(CELL, driver.period_s)
    with Session(CELL, driver, line, SilentRecorder()) as session:
        source = Covered(driver.world, CLEAN)
        with pytest.raises(SafetyStop, match="S16: nobody has seen PSM2 at 3 poses running"):
            collect(session, source, POSES, tmp_path, "seed 0")
    assert (~load(tmp_path / "PSM1.csv").speeds.any(axis=1)).sum() == 3


def test_after_a_hold_a_person_may_let_it_go_on_where_it_was(tmp_path: Path) -> None:
    driver = LoopbackDriver(CELL, WorldOptions(PERIOD_S))
    driver.connect()
    driver.reset(load_task("bipegtransfer").sample_layout(np.random.default_rng(0), "reference"))

    class LettingGo(SimulatedTracker):
        looks = 0

        def look(self, now: float) -> None:
            super().look(now)
            self.looks += 1
            if self.looks == 480:
                driver.say(consent=False)

    class Sorry(Person):
        def ask(self, question: str) -> None:
            super().ask(question)
            driver.say(consent=True)

    person, source = Sorry(thinks=60), LettingGo(driver.world, CLEAN)
    line = Line(CELL, driver.period_s)
    consent = PersonsConsent(driver, person.tell)
    with Session(CELL, driver, line, SilentRecorder(), consent=consent) as session:
        found = collect(session, source, POSES[:6], tmp_path, "seed 0", operator=person)
    assert (found.measured, found.skipped) == (6, 0)
    assert len(person.asked) == 1
    assert "held (S22" in person.asked[0]
    m = load(found.files["PSM1"])
    there = task_poses(CELL, 0, m.joints)[:, :3, 3]
    np.testing.assert_allclose(m.points, there, atol=2e-5)
