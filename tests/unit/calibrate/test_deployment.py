"""Trials on hidden robots are counted rightly, are never run twice, and none is lost."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from calibrations import exact_calibration
from typer.testing import CliRunner

from viskill_deploy.calibrate import collect, deployment
from viskill_deploy.calibrate.deployment import (
    CALIBRATED,
    EXACT,
    TRIALS,
    UNCALIBRATED,
    Condition,
    Deployment,
    Trial,
    read_trials,
    run,
)
from viskill_deploy.calibrate.deployment_page import figures, interval, page
from viskill_deploy.calibrate.truths import hidden_robot
from viskill_deploy.cli.main import app
from viskill_deploy.core.calibration_files import write_calibration
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import CalibrationError, SafetyStop
from viskill_deploy.core.types import Boundary
from viskill_deploy.runtime.ledger import EpisodeResult

BUNDLE = Path(__file__).parents[3] / "policies" / "bipegtransfer-viskill"
WHAT = Deployment(BUNDLE, robots=1, trials=1)


def trial(
    condition: Condition = "calibrated plan", success: bool = True, robot: int = 100
) -> Trial:
    return Trial(robot, 0, condition, success, (0.0131, -0.0271), 4e-4, -0.03, "", "", 1.0)


def test_the_papers_sixteen_of_twenty_are_known_to_34_percent() -> None:
    assert interval(16, 20) == pytest.approx((0.5840, 0.9193), abs=5e-5)
    low, high = interval(20, 20)
    assert (low, high) == (pytest.approx(0.8389, abs=5e-5), 1.0)
    assert interval(0, 20) == pytest.approx((0.0, 1.0 - low), abs=1e-12)


def test_figures_tell_conditions_and_robots_apart() -> None:
    trials = [trial(success=False), trial(), trial(robot=101), trial("uncalibrated plan", False)]
    trials[3] = replace(trials[3], stopped_by="S17")
    found = figures(WHAT, trials)
    assert found["simulated"] is True
    part = found["conditions"]["calibrated plan"]
    assert (part["successes"], part["trials"], part["robots"]) == (2, 3, 2)
    assert (part["worst_robot"], part["best_robot"]) == (0.5, 1.0)
    assert found["conditions"]["uncalibrated plan"]["stopped"] == 1
    assert found["conditions"]["calibrated closed-loop"]["trials"] == 0
    assert found["conditions"][EXACT]["trials"] == 0


def test_the_page_says_that_it_is_simulated_and_puts_every_trial_in_its_rows() -> None:
    text = page(WHAT, [trial(), trial("calibrated closed-loop", False)], "viskill reproduce x")
    assert "**All of this is simulated.**" in text
    assert "| the paper's dVRK, plan | 1 | 16 of 20 | 80 % | 58 to 92 % | - | - |" in text
    assert "| simulated, uncalibrated plan | 0 | not run | - | - | - | 0 |" in text
    assert "| 0.25 to 0.5 mm | 1 of 1 (21 to 100 %) | 0 of 1 (0 to 79 %) |" in text
    assert "| 1 to 2 deg | 1 of 1" in text
    assert "| (13, -27) mm | 1 of 1" in text
    assert "`viskill reproduce x`" in text


def test_a_trial_that_was_cut_off_while_it_was_written_is_run_again(tmp_path: Path) -> None:
    path = tmp_path / TRIALS
    assert read_trials(path, WHAT) == []
    whole = path.read_text() + json.dumps(asdict(trial())) + "\n"
    path.write_text(whole + '{"robot": 100, "num')
    assert read_trials(path, WHAT) == [trial()]
    assert path.read_text() == whole
    with pytest.raises(CalibrationError, match="name another folder"):
        read_trials(path, replace(WHAT, seed=7))


@pytest.mark.parametrize("what", ["manifest", "cell", "way of measuring"])
def test_trials_of_another_bundle_cell_or_way_of_measuring_are_not_mixed(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_trials(tmp_path / TRIALS, WHAT)
    if what == "way of measuring":
        monkeypatch.setattr(collect, "VERSION", collect.VERSION + 1)
    else:
        file = (
            BUNDLE / "manifest.json" if what == "manifest" else load_cell("bipegtransfer").files[0]
        )
        real = Path.read_bytes
        monkeypatch.setattr(
            Path, "read_bytes", lambda path: real(path) + b" " * (path.name == file.name)
        )
    with pytest.raises(CalibrationError, match="holds trials of"):
        read_trials(tmp_path / TRIALS, WHAT)


def test_only_what_is_not_there_yet_is_run(tmp_path: Path) -> None:
    cell = load_cell("bipegtransfer")
    truth = hidden_robot("100", cell).truth.errors(cell)
    write_calibration(tmp_path / "robot-100.json", exact_calibration(cell, truth))
    read_trials(tmp_path / TRIALS, WHAT)
    with (tmp_path / TRIALS).open("a") as file:
        for condition in WHAT.conditions[:2]:
            file.write(json.dumps(asdict(trial(condition))) + "\n")
    told: list[str] = []
    trials = run(WHAT, tmp_path, tell=told.append)
    assert [t.condition for t in trials] == list(WHAT.conditions)
    assert trials[2].success
    assert 0.0 < trials[2].seen_off_m < 0.003
    assert told == [
        "robot 100 is calibrated",
        "robot 100, trial 0, calibrated closed-loop: done",
        "robot 100, trial 0, exactly known arms, closed-loop: done",
    ]
    by_file, known = (replace(trial, condition=EXACT, seconds=0.0) for trial in trials[2:])
    assert known == by_file, "the calibration that was written here is exact"
    arguments = ["reproduce", str(tmp_path), "--deployment", "--robots", "1", "--trials", "1"]
    done = CliRunner().invoke(app, [*arguments, "--json", "-o", str(tmp_path / "page.md")])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["conditions"]["calibrated plan"]["trials"] == 1
    assert "--robots 1 --trials 1`" in (tmp_path / "page.md").read_text()


def test_a_trial_says_when_the_policys_value_was_too_low_to_go_on() -> None:
    seen = Boundary("", "grasp", (), 0.478, 0.5, "safe pose", "")
    given_up = EpisodeResult(0, boundaries=[seen])
    assert deployment._given_up(given_up) == "value 0.48 before grasp is below 0.50"
    assert not deployment._given_up(EpisodeResult(0, boundaries=[replace(seen, course="retry")]))
    assert not deployment._given_up(EpisodeResult(0, boundaries=[replace(seen, value=0.9)]))
    assert not deployment._given_up(EpisodeResult(0))


def test_a_robot_that_cannot_be_calibrated_is_told_and_counts_as_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def measure(*_: object) -> None:
        raise SafetyStop("the gate stepped in (S17)")

    monkeypatch.setattr(deployment, "_measure", measure)
    what = replace(WHAT, conditions=(UNCALIBRATED[0], *CALIBRATED))
    read_trials(tmp_path / TRIALS, what)
    with (tmp_path / TRIALS).open("a") as file:
        file.write(json.dumps(asdict(trial(UNCALIBRATED[0]))) + "\n")
    told: list[str] = []
    _, *calibrated = run(what, tmp_path, tell=told.append)
    assert told[0] == "robot 100 is not calibrated: the gate stepped in (S17)"
    assert [t.refused for t in calibrated] == [deployment.NOT_CALIBRATED] * 2
    assert not any(t.success for t in calibrated)


def test_robots_may_be_a_part_of_as_wrong_and_stay_uncalibrated(tmp_path: Path) -> None:
    what = replace(WHAT, scale=0.25, conditions=UNCALIBRATED)
    read_trials(tmp_path / TRIALS, what)
    with (tmp_path / TRIALS).open("a") as file:
        file.write(json.dumps(asdict(trial(UNCALIBRATED[0], False))) + "\n")
    told: list[str] = []
    trials = run(what, tmp_path, tell=told.append)
    assert [t.condition for t in trials] == list(UNCALIBRATED)
    assert len(told) == 1, "nothing is calibrated"
    assert 0.0 < trials[1].seen_off_m < 0.0008
    arguments = ["reproduce", str(tmp_path), "--deployment", "--robots", "1", "--trials", "1"]
    arguments += ["--scale", "0.25", "--uncalibrated", "-o", str(tmp_path / "page.md")]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    text = (tmp_path / "page.md").read_text()
    assert "--robots 1 --trials 1 --scale 0.25 --uncalibrated`" in text
    assert "seed and then taken times 0.25." in text
    assert f"| simulated, uncalibrated closed-loop | 1 | {trials[1].success:d} of 1 |" in text
    assert "calibrated plan" not in text.replace("uncalibrated plan", "")
