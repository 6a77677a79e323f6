"""A dry run is made of the same files as the run on the robot: cell, calibration, scene."""

import time
from pathlib import Path

import numpy as np
import pytest
from calibrations import write_fresh
from lab_files import SCENE
from silent_recorder import SilentRecorder
from typer.testing import CliRunner

from viskill_deploy.cli.main import app
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.core.types import Scene
from viskill_deploy.drivers.loopback_served import ServedLoopback
from viskill_deploy.motion.links import CellLinks
from viskill_deploy.runtime.dry_run import DryRunOptions, dry_run, layout_of
from viskill_deploy.runtime.episodes import Mode
from viskill_deploy.runtime.preflight import Sources, prepare
from viskill_deploy.sim.world import WorldOptions

ROOT = Path(__file__).resolve().parents[3]
BUNDLE = ROOT / "policies/bipegtransfer-viskill"


class FirstScene(SilentRecorder):
    """Keeps the first scene of the run."""

    first: Scene | None = None

    def scene(self, now: float, scene: Scene) -> None:
        self.first = self.first or scene


def test_a_dry_run_starts_from_the_scene_file_with_the_calibrated_cell(tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE, encoding="utf-8")
    calibration = write_fresh(tmp_path / "cell.json", load_cell("bipegtransfer"))
    prepared = prepare(Sources(BUNDLE, "bipegtransfer", calibration, scene, time.time()))
    recorder = FirstScene()
    options = DryRunOptions(mode="plan", world=WorldOptions(0.01))
    figures = dry_run(prepared, options, recorder).figures
    assert figures["distribution"] == "scene.toml"
    assert figures["success_rate"] == 1.0
    assert recorder.first is not None
    assert recorder.first.active == "block1"
    np.testing.assert_allclose(recorder.first.pose("block1")[:2, 3], [0.013, -0.027], atol=5e-4)
    used = {entry["path"] for entry in figures["files"]}
    assert {str(scene), str(calibration)} <= used


@pytest.mark.parametrize("mode", ["closed-loop", "plan"])
def test_every_episode_draws_its_layout_where_nobody_says_where_things_are(mode: Mode) -> None:
    prepared, rng = prepare(BUNDLE), np.random.default_rng(0)
    places = []
    for _ in range(2):
        layout = layout_of(prepared, DryRunOptions(mode=mode), rng)
        places.append(layout.pose(layout.active)[:2, 3])
    assert not np.allclose(places[0], places[1])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["policy.plan.json", "--scene", "scene.toml"], "go with a policy bundle"),
        ([str(BUNDLE), "--scene", "scene.toml", "--distribution", "wide"], "leave --distribution"),
        ([str(BUNDLE), "--stuck-joint", "PSM1/foo"], "PSM1/pitch, PSM1/insertion, PSM1/roll"),
        ([str(BUNDLE), "--stuck-joint", "PSM1/jaw"], "PSM2/yaw"),
    ],
)
def test_files_that_contradict_each_other_are_a_wrong_use(
    arguments: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    (tmp_path / "scene.toml").write_text(SCENE, encoding="utf-8")
    run = CliRunner().invoke(app, ["dry-run", *arguments])
    assert run.exit_code == 2
    assert words in " ".join(run.output.replace("│", " ").split())


def test_a_scene_with_a_thing_that_the_cell_lacks_is_refused_before_there_is_a_run(
    tmp_path: Path,
) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE.replace("block1", "blok1"), encoding="utf-8")
    folder = tmp_path / "run"
    options = ["--scene", str(scene), "--output", str(folder)]
    run = CliRunner().invoke(app, ["dry-run", str(BUNDLE), *options])
    assert isinstance(run.exception, DataFileError)
    assert "scene.toml: object: no object 'blok1'" in str(run.exception)
    assert not folder.exists()


def test_the_served_loopback_is_the_cell_of_the_file(tmp_path: Path) -> None:
    own = tmp_path / "lab.toml"
    text = (ROOT / "robots/cells/bipegtransfer.toml").read_text(encoding="utf-8")
    start = "start_position_m = [-0.05, 0.05, 0.0581]"
    assert start in text
    own.write_text(text.replace(start, "start_position_m = [-0.04, 0.05, 0.0581]"))
    cell = load_cell(str(own))
    driver = ServedLoopback(cell)
    driver.connect()
    try:
        joints = [arm.setpoint_jp for arm in driver.state().arms]
        tip = CellLinks(cell).tips(joints)[0]
        assert tip[0, 3] == pytest.approx(-0.04, abs=1e-3)
    finally:
        driver.close()
