"""A scene that is touched, or seen: written with covariances, read by the runs, or refused."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from calibrations import write_fresh
from typer.testing import CliRunner

from viskill_deploy.calibrate.seen_poses import averaged, look_on, read_looks, write_looks
from viskill_deploy.cli.main import app
from viskill_deploy.core.clock import SteppedClock
from viskill_deploy.core.description import load_cell, rpy_matrix
from viskill_deploy.core.errors import CalibrationError, DataFileError
from viskill_deploy.core.scene_files import BoardEntry, SceneFile, read_scene, write_scene
from viskill_deploy.core.types import FloatArray
from viskill_deploy.runtime.checklist import Checklist
from viskill_deploy.runtime.poses import Sighting
from viskill_deploy.runtime.preflight import Sources, look_at_files
from viskill_deploy.sim.tasks.base import load_task

RUN = CliRunner()
CELL = load_cell("bipegtransfer")
BUNDLE = Path(__file__).resolve().parents[2] / "policies/bipegtransfer-viskill"


def lying(name: str, seed: int = 0) -> FloatArray:
    """Where a thing of the simulated cell lies."""
    layout = load_task("bipegtransfer").sample_layout(np.random.default_rng(seed), "reference")
    return next(t.T_task_object for t in layout.objects if t.name == name)


def test_a_scene_is_touched_and_the_runs_read_it(tmp_path: Path) -> None:
    file = tmp_path / "scene.toml"
    scene = ["calibrate", "scene", str(tmp_path / "touched"), "-o", str(file)]
    scene += ["--things", "block0,block2", "--active", "block2", "--calibration"]
    scene += [str(write_fresh(tmp_path / "cell.json", CELL))]
    done = RUN.invoke(app, [*scene, "--json"])
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["board"]["points"] == 8
    assert told["board"]["held_out_median_m"] < 2e-3
    seen = read_scene(file, "bipegtransfer")
    assert seen.scene.active == "block2"
    np.testing.assert_allclose(seen.scene.goal, (0.01, 0.043, 0.00725))
    for thing in seen.scene.objects:
        there, sigma = lying(thing.name), np.sqrt(np.diag(seen.covariance[thing.name]))
        off = thing.T_task_object[:2, 3] - there[:2, 3]
        assert np.abs(off / sigma[:2]).max() < 3.5
        assert 4e-4 < sigma[0] < 1e-3, "the calibration's 0.6 mm are part of it"
        turn = thing.T_task_object[:3, :3] @ there[:3, :3].T
        assert abs(np.arctan2(turn[1, 0], turn[0, 0])) < 3.5 * sigma[5]
    checklist = Checklist()
    prepared = look_at_files(checklist, Sources(BUNDLE, scene=file))
    assert prepared is not None
    assert prepared.scene is not None
    again = RUN.invoke(app, scene)  # all was touched: nothing is asked, the same is written
    assert again.exit_code == 0
    assert "board: " in again.stdout
    assert read_scene(file, "bipegtransfer").scene.objects[0].name == "block0"
    assert not (tmp_path / "touched" / "PSM1.csv").exists()
    touched = tmp_path / "touched" / "PSM2.csv"
    os.utime(touched, (0, touched.stat().st_mtime - 4000))
    late = RUN.invoke(app, scene)
    assert "things may have moved since; name another folder" in str(late.exception)


def test_a_board_that_is_elsewhere_is_no_scene(tmp_path: Path) -> None:
    truth = {"schema": 1, "cell": CELL.name, "arms": {arm.name: {} for arm in CELL.arms}}
    path, file = tmp_path / "truth.json", tmp_path / "scene.toml"
    path.write_text(json.dumps(truth | {"board_translation_m": [0.004, 0.0, 0.0]}))
    scene = ["calibrate", "scene", str(tmp_path / "t"), "-o", str(file), "--truth", str(path)]
    done = RUN.invoke(app, scene)
    assert isinstance(done.exception, CalibrationError)
    assert "calibrate fit FOLDER --calibration OLD" in str(done.exception)
    assert not file.exists()


def test_what_cannot_be_touched_has_to_be_seen(tmp_path: Path) -> None:
    scene = ["calibrate", "scene", str(tmp_path), "-o", str(tmp_path / "s.toml")]
    rings = RUN.invoke(app, [*scene, "--cell", "bipegboard", "--goal", "0,0,0.02"])
    assert "has no [block]; measure where its things are with a tracker" in str(rings.exception)
    for goal in ("peg12", "there", "0.1,0.2"):
        assert "the goal" in str(RUN.invoke(app, [*scene, "--goal", goal]).exception)
    assert RUN.invoke(app, [*scene, "--arm", "PSM3"]).exit_code == 2
    assert RUN.invoke(app, [*scene, "--pose-topic", "/block0/measured_cp"]).exit_code == 2


def looks(n: int, seed: int, wrong: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (n, 1, 1))
    for pose in T:
        pose[:3, :3] = rpy_matrix(*rng.normal([0.0, 0.0, 0.3], 0.01))
        pose[:3, 3] = rng.normal([0.013, -0.027, 0.00725], 2e-4)
    for pose in T[:wrong]:
        pose[:3, 3] += rng.normal(0.0, 0.05, 3)
    for pose in T[wrong : 2 * wrong]:
        pose[:3, :3] = rpy_matrix(0.0, 1.0, 2.0)
    return T


def test_a_scene_is_taken_from_looks_of_which_some_are_wrong(tmp_path: Path) -> None:
    rows = list(enumerate(looks(60, 0, wrong=8)))
    path = write_looks(tmp_path / "poses.csv", {"block0": [(float(i), T) for i, T in rows]})
    np.testing.assert_allclose(read_looks(path)["block0"][20][1], rows[20][1], atol=1e-12)
    scene = ["calibrate", "scene", str(tmp_path), "-o", str(tmp_path / "scene.toml")]
    done = RUN.invoke(app, [*scene, "--poses", str(path), "--accuracy", "0.0004", "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["things"]["block0"]["left_out"] >= 16
    seen = read_scene(tmp_path / "scene.toml", "bipegtransfer")
    np.testing.assert_allclose(
        seen.scene.objects[0].T_task_object[:3, 3], (0.013, -0.027, 0.00725), atol=1.5e-4
    )
    assert np.sqrt(seen.covariance["block0"][0, 0]) == pytest.approx(4e-4, rel=0.02)
    gone = RUN.invoke(app, [*scene, "--poses", str(path), "--things", "block0,block1"])
    assert "block1 was seen 0 times" in str(gone.exception)


def test_the_covariance_of_looks_is_honest() -> None:
    scores = []
    for seed in range(40):
        mean = averaged("block0", looks(30, seed), 0.0, 0.0)
        off = mean.T[:3, 3] - [0.013, -0.027, 0.00725]
        scores.append(off @ np.linalg.solve(mean.covariance[:3, :3], off))
    assert np.mean(scores) == pytest.approx(3.0, rel=0.4)  # chi square of three


def test_looks_that_say_nothing_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="seen 4 times"):
        averaged("block0", looks(4, 0), 0.0, 0.0)
    moving = looks(60, 0)
    moving[:, 0, 3] += np.linspace(0.0, 0.05, 60)
    with pytest.raises(CalibrationError, match="moves"):
        averaged("block0", moving, 0.0, 0.0)
    head = "stamp_s,name,x_m,y_m,z_m,qx,qy,qz,qw\n"
    for row, words in {
        "0,block0,nan,0,0,0,0,0,1": "row 1 is no pose",
        "0,block0,0,0,0,0,0,0,2": "row 1 is no pose",
        "0,block0,13,-27,7,0,0,0,1": "positions are in m",
        "0,block0,0,0": "row 1: needs a number",
    }.items():
        (tmp_path / "p.csv").write_text(head + row + "\n")
        with pytest.raises(CalibrationError, match=words):
            read_looks(tmp_path / "p.csv")
    with pytest.raises(CalibrationError, match="cannot be read"):
        read_looks(tmp_path / "none.csv")


class Tracker:
    """Sees a new pose at every second look."""

    count = 0

    def newest(self, name: str) -> Sighting | None:
        self.count += 1
        return Sighting(np.eye(4), float(self.count // 2), 0.0) if self.count > 2 else None

    def close(self) -> None:
        """Nothing to end."""


def test_a_look_counts_once() -> None:
    seen = look_on(Tracker(), ["block0"], SteppedClock(), 0.2)
    assert [stamp for stamp, _ in seen["block0"]] == [float(i) for i in range(1, 11)]


def test_a_scene_file_comes_back_as_it_was_written(tmp_path: Path) -> None:
    C = (np.diag([1e-6, 2e-6, 3e-6, 1e-4, 1e-4, 1e-3]) + 1e-8).tolist()
    thing = {"name": "block1", "position_m": (0.01, 0.02, 0.003), "covariance": C}
    board = {"position_m": (0.0005, 0.0, 0.0), "covariance": C, "held_out_m": 0.0004}
    content = {"schema": 1, "cell": "bipegtransfer", "active": "block1", "goal_m": (0, 0, 0)}
    file = SceneFile.model_validate(content | {"object": [thing], "board": board})
    path = write_scene(tmp_path / "s.toml", file)
    seen = read_scene(path, "bipegtransfer")
    np.testing.assert_allclose(seen.covariance["block1"], C)
    path.write_text(path.read_text().replace("0.0005", "0.0016"))
    with pytest.raises(DataFileError, match=r"board: .*1\.6 mm and 0\.0 degrees"):
        read_scene(path, "bipegtransfer")
    tilted = board | {"rotation_rpy_rad": (0.0, 0.0, 0.03)}
    with pytest.raises(ValueError, match=r"1\.7 degrees"):
        BoardEntry.model_validate(tilted)
