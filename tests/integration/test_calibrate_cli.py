"""`viskill calibrate` from the command line: measure a hidden robot, fit it, study it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from measured_arm import TYPICAL, cell_arm, measured, true_points
from typer.testing import CliRunner

from viskill_deploy.calibrate.measurements import save
from viskill_deploy.calibrate.truths import draw_robot
from viskill_deploy.cli.main import app
from viskill_deploy.core.calibration_files import calibrated, read_calibration
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import CalibrationError

RUN = CliRunner()


@pytest.mark.no_cover
def test_a_hidden_robot_is_measured_fitted_and_found(tmp_path: Path) -> None:
    points, file = tmp_path / "points", tmp_path / "calibration" / "cell.json"
    collect = ["calibrate", "collect", str(points), "--samples", "24", "--truth", "3"]
    done = RUN.invoke(app, [*collect, "--outliers", "0"])
    assert done.exit_code == 0, done.output
    fit = ["calibrate", "fit", str(points), "-o", str(file)]
    done = RUN.invoke(app, [*fit, "--json"])
    assert done.exit_code == 0, done.output
    facts = json.loads(done.stdout)["arms"]["PSM1"]
    truth = draw_robot(load_cell("bipegtransfer"), 3).arms["PSM1"]
    longer = truth.joint_offset[2] + truth.tool_length_m  # no point tells them apart
    assert facts["parameters"]["offset_insertion_m"] == pytest.approx(longer, abs=3e-3)
    assert facts["held_out_median_m"] < 1.5e-3
    assert "offset_yaw_rad" in facts["frozen"]
    calibration = read_calibration(file)
    assert calibration.arms[0].sigma["base_translation_x_m"] > 0.0
    cell = calibrated(load_cell("bipegtransfer"), calibration, file)
    assert not np.array_equal(cell.arms[0].T_task_base, cell.filed.arms[0].T_task_base)  # type: ignore[union-attr]
    done = RUN.invoke(app, fit)
    assert "the data do not tell" in done.stdout
    assert "median" in done.stdout
    assert "look at the tracker's clock" not in done.stdout


@pytest.mark.parametrize(("delay_s", "words"), [(0.04, 0), (0.09, 2)])
def test_stamps_that_are_later_than_joints_are_followed_are_told(
    delay_s: float, words: int, tmp_path: Path
) -> None:
    for index, arm in enumerate(load_cell("bipegtransfer").arms):
        m, _ = measured(cell_arm(index), replace(TYPICAL, delay_s=delay_s), 120, seed=index)
        save(m, tmp_path / f"{arm.name}.csv")
    done = RUN.invoke(app, ["calibrate", "fit", str(tmp_path), "-o", str(tmp_path / "c.json")])
    assert done.exit_code == 0, done.output
    assert done.stdout.count("look at the tracker's clock") == words


def test_a_delay_that_nobody_knows_is_told_as_nothing(tmp_path: Path) -> None:
    for index, arm in enumerate(load_cell("bipegtransfer").arms):
        m, _ = measured(cell_arm(index), TYPICAL, 120, seed=index)
        still = replace(m, speeds=np.zeros((120, 6)), accelerations=np.zeros((120, 6)))
        at_rest = true_points(cell_arm(index), TYPICAL, still)
        save(replace(still, points=at_rest), tmp_path / f"{arm.name}.csv")
    done = RUN.invoke(app, ["calibrate", "fit", str(tmp_path), "-o", str(tmp_path / "c.json")])
    assert done.exit_code == 0, done.output
    assert "look at the tracker's clock" not in done.stdout


@pytest.mark.no_cover
def test_a_dry_run_on_a_hidden_robot_says_which_and_sees_nothing_else_of_it(
    tmp_path: Path,
) -> None:
    file, run = tmp_path / "robot.json", tmp_path / "run"
    done = RUN.invoke(app, ["calibrate", "truth", "3", "-o", str(file)])
    assert done.exit_code == 0, done.output
    dry = ["dry-run", "policies/bipegtransfer-viskill", "--mode", "plan", "--no-video", "--json"]
    done = RUN.invoke(app, [*dry, "--truth", str(file), "--output", str(run)])
    result = json.loads(done.stdout)
    assert result["truth"]["file"] == str(file)
    assert result["success_rate"] == 0.0
    assert f"{file}, {result['truth']['sha256'][:12]}" in (run / "report.html").read_text()
    assert str(file) not in [entry["path"] for entry in result["files"]]


def test_measurements_of_one_arm_alone_are_refused(tmp_path: Path) -> None:
    done = RUN.invoke(app, ["calibrate", "fit", str(tmp_path), "-o", str(tmp_path / "c.json")])
    assert isinstance(done.exception, CalibrationError)
    assert not (tmp_path / "c.json").exists()


@pytest.mark.no_cover
def test_a_study_goes_on_where_it_was(tmp_path: Path) -> None:
    trials = tmp_path / "trials.jsonl"
    study = ["calibrate", "study", "--samples", "14", "--output", str(trials), "--json"]
    done = RUN.invoke(app, [*study, "--truths", "1"])
    assert done.exit_code == 0, done.output
    first = trials.read_text()
    trials.write_text(first + '{"tracker": [{"truth": [0.1,')  # cut off while it was written
    done = RUN.invoke(app, [*study, "--truths", "1"])
    assert done.exit_code == 0, done.output
    result = json.loads(done.stdout)
    assert result["truths"] == 1
    assert result["arms"] == 2
    assert result["tip_error_median_m"] < result["uncalibrated_tip_error_median_m"]
    assert result["touch"]["tip_error_median_m"] < result["uncalibrated_tip_error_median_m"]
    assert result["touch"]["samples_median"] == 12
    assert result["failed"] == []
    assert trials.read_text() == first
    other = RUN.invoke(app, [*study, "--seed", "9"])
    assert isinstance(other.exception, CalibrationError)
