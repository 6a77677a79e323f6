"""A robot that nobody knows, from the first measurement to the task done: all of it over CRTK."""

from __future__ import annotations

import datetime
import json
from pathlib import Path

import numpy as np
import pytest
from operators import Person
from silent_recorder import SilentRecorder
from typer.testing import CliRunner

from viskill_deploy.calibrate.apply import calibration_file
from viskill_deploy.calibrate.collect import collect
from viskill_deploy.calibrate.fit import fit_arm
from viskill_deploy.calibrate.measurements import load
from viskill_deploy.calibrate.programme import choose_poses
from viskill_deploy.calibrate.topic_tips import TopicTips
from viskill_deploy.calibrate.truths import MARKER_M, hidden_robot
from viskill_deploy.cli import collect as collect_command
from viskill_deploy.cli.main import app
from viskill_deploy.core.calibration_files import write_calibration
from viskill_deploy.core.clock import wall_time
from viskill_deploy.core.description import load_cell
from viskill_deploy.drivers.crtk.server_options import ServerOptions
from viskill_deploy.drivers.crtk.simulated import SteppedCrtk
from viskill_deploy.drivers.crtk.tips_on_wire import tip_topic
from viskill_deploy.runtime.consent import PersonsConsent
from viskill_deploy.runtime.execution import ExecuteOptions, execute, look_before
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.preflight import Sources, prepare
from viskill_deploy.runtime.robots import Robot
from viskill_deploy.runtime.session import Session
from viskill_deploy.sim.tasks.base import load_task
from viskill_deploy.sim.world import WorldOptions

pytestmark = pytest.mark.no_cover

BUNDLE = Path(__file__).parents[2] / "policies" / "bipegtransfer-viskill"
CELL = load_cell("bipegtransfer")
ARMS = [arm.name for arm in CELL.arms]
HIDDEN = hidden_robot("3", CELL)
PERIOD_S = 0.01
POSES = 16


def _robot() -> SteppedCrtk:
    """The hidden robot, as a dVRK that has just been switched on, with a tracker beside it."""
    world = HIDDEN.world(CELL, WorldOptions(period_s=PERIOD_S))
    server = ServerOptions(homing="dvrk", tracker=HIDDEN.tracker(CELL))
    driver = SteppedCrtk(CELL, world, 0, server)
    driver.connect()
    task = load_task(CELL.name)
    driver.reset(task.sample_layout(np.random.default_rng(0), task.distributions[0]))
    return driver


class Tips(TopicTips):
    """Ends the program after so many looks."""

    left = 10**9

    def look(self, now: float) -> None:
        super().look(now)
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt


def _collect(folder: Path, looks: int = 10**9) -> tuple[dict[str, Path], Person]:
    driver, person = _robot(), Person()
    tips = Tips(driver.node, {name: tip_topic(name) for name in ARMS}, MARKER_M)
    tips.left = looks
    poses = np.stack([choose_poses(CELL, arm, POSES, 0) for arm in range(2)], axis=1)
    consent = PersonsConsent(driver, person.tell)
    line = Line(CELL, driver.period_s)
    with Session(CELL, driver, line, SilentRecorder(), consent=consent) as session:
        found = collect(session, tips, poses, folder, "joined", operator=person)
    assert found.skipped <= 2
    return dict(found.files), person


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What is found by going through the robot's workspace, cut off once on the way."""
    folder = tmp_path_factory.mktemp("joined")
    with pytest.raises(KeyboardInterrupt):
        _collect(folder / "points", looks=1500)
    kept = (folder / "points" / "PSM1.csv").read_text()
    whole = kept[: kept.rfind(" done\n") + 6]
    assert 2 <= whole.count(" done\n") < POSES
    files, person = _collect(folder / "points")
    assert sum("press the consent pedal" in note for note in person.told) == 2
    assert files["PSM1"].read_text().startswith(whole)
    fits = {name: fit_arm(CELL.arms[i], load(files[name])) for i, name in enumerate(ARMS)}
    now = datetime.datetime.now(datetime.UTC)
    return write_calibration(
        folder / "cell.json", calibration_file(CELL, fits, files, now, "the joined run")
    )


def test_calibrated_by_what_came_over_the_wire_the_task_is_done(calibration: Path) -> None:
    prepared = prepare(Sources(BUNDLE, calibration=calibration, date_s=wall_time()))
    driver = _robot()
    options = ExecuteOptions(speed=1.0)
    look_before(prepared, options, driver).insist()
    outcome = execute(prepared, options, driver, SilentRecorder(), Person())
    assert outcome.failure is None
    assert outcome.figures["interventions"] == 0
    assert outcome.figures["episode_results"][0]["success"]


def test_uncalibrated_it_is_not() -> None:
    outcome = execute(
        prepare(BUNDLE), ExecuteOptions(speed=1.0), _robot(), SilentRecorder(), Person()
    )
    assert outcome.failure is None
    result = outcome.figures["episode_results"][0]
    assert not result["success"]
    assert result["stopped_by"] == "S17", "an arm is on the board, and cannot follow"


def test_the_command_looks_at_the_robot_says_what_it_will_do_and_measures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    driver = _robot()
    robot = Robot(driver, driver.node, is_lent=True)
    monkeypatch.setattr(collect_command, "connected", lambda cell, options: robot)
    monkeypatch.setattr(TopicTips, "insist", lambda self: None)  # no time passes yet
    arguments = ["calibrate", "collect", str(tmp_path / "points"), "--driver", "crtk", "--yes"]
    done = CliRunner().invoke(app, [*arguments, "--samples", "8", "--speed", "1", "--json"])
    assert done.exit_code == 0, done.output
    files = json.loads(done.stdout)["files"]
    assert [len(load(Path(files[name]))) >= 6 for name in ARMS] == [True, True]
    said = " ".join(done.stderr.split())
    assert "PSM1, PSM2 are heard" in said
    assert "all over their workspace" in said
    assert said.count("press the consent pedal") == 2
    refused = CliRunner().invoke(app, [*arguments, "--truth", "3"])
    assert refused.exit_code == 2
    assert "loopback" in refused.output
