"""`--fault` from the command line: exit code, figures, report and a record up to the fault."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from viskill_deploy.cli.main import app
from viskill_deploy.observe.reading import read_recording

BUNDLE = Path(__file__).parents[2] / "policies" / "bipegtransfer-viskill"


def dry_run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "viskill_deploy.cli.main", "dry-run", str(BUNDLE)]
    command += ["--no-video", "--output", str(folder), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def check_record(folder: Path, until_s: float) -> None:
    """The record opens and holds every period up to a time since the first cycle."""
    times = read_recording(folder / "recording").joints["/PSM1/measured_js"].time_s
    assert times[-1] - times[0] >= until_s - 0.012
    assert np.diff(times).max() < 0.0041


def test_a_fault_ends_the_run_with_exit_5_and_stands_in_all_results(tmp_path: Path) -> None:
    done = dry_run(tmp_path / "run", "--fault", "drop@1.0:0.3", "--fault", "duplicate@0.5")
    assert done.returncode == 5, done.stderr
    assert "fault drop@1:0.3: no new sample arrives; declared: held within 60 ms" in done.stdout
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    drop, duplicate = result["faults"]
    assert (drop["seen_action"], drop["seen_rules"]) == ("HOLD", ["S18"])
    assert drop["seen_after_s"] <= drop["declared_within_s"]
    assert duplicate["declared_rule"] == ""
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    assert "drop@1:0.3" in page
    data = read_recording(tmp_path / "run" / "recording")
    assert data.complete
    assert [mark.note for mark in data.marks if mark.note.startswith("fault")] == [
        "fault duplicate@0.5",
        "fault drop@1:0.3",
    ]
    check_record(tmp_path / "run", 1.05)


def test_a_run_that_is_killed_leaves_a_record_up_to_that_moment(tmp_path: Path) -> None:
    done = dry_run(tmp_path / "run", "--fault", "kill-runtime@1.0")
    assert done.returncode == -signal.SIGKILL
    bag = tmp_path / "run" / "recording"
    for _ in range(200):  # the recorder's process ends by itself, a moment later
        if (bag / "metadata.yaml").exists():
            break
        os.sched_yield()
        subprocess.run(["sleep", "0.05"], check=True)
    check_record(tmp_path / "run", 1.0)
    assert read_recording(bag).complete


def test_a_full_disk_ends_the_run_and_what_was_written_opens(tmp_path: Path) -> None:
    done = dry_run(tmp_path / "run", "--fault", "recorder-full@1.5")
    assert done.returncode == 5, done.stderr
    (fault,) = json.loads((tmp_path / "run" / "result.json").read_text())["faults"]
    assert (fault["seen_action"], fault["seen_rules"]) == ("STOP", ["S32"])
    data = read_recording(tmp_path / "run" / "recording")
    assert not data.complete


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--fault", "melt@1"], "viskill faults"),
        (["--fault", "drop@soon"], "name@start"),
        (["--fault", "hung-policy@1", "--mode", "plan"], "before anything moves"),
    ],
)
def test_a_fault_that_cannot_be_is_a_usage_error(tmp_path, arguments, words) -> None:
    run = ["dry-run", str(BUNDLE), "--output", str(tmp_path / "run"), *arguments]
    done = CliRunner().invoke(app, run)
    assert done.exit_code == 2
    assert words in " ".join(done.output.replace("│", " ").split())
    assert not (tmp_path / "run").exists()


def test_viskill_faults_lists_them_all() -> None:
    listed = CliRunner().invoke(app, ["faults"])
    assert listed.exit_code == 0
    assert "drop: no new sample arrives; held within 60 ms: age of the feedback" in listed.output
    assert len(json.loads(CliRunner().invoke(app, ["faults", "--json"]).output)) == 28
