"""Policies that were made elsewhere, from files to a report, each run a process of its own."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import official_files as files
import pytest

from viskill_deploy.observe.reading import read_recording


def viskill(*arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "viskill_deploy.cli.main", *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)


def still(key: str, shape: tuple[int, ...]) -> np.ndarray:
    """Weights of a policy that keeps still, jaws closed."""
    values = np.zeros(shape, dtype=np.float32)
    if key.endswith("actor.trunk.mlp.6.bias"):
        values[4::5] = -5.0
    return values


def test_official_checkpoints_go_through_the_whole_line_to_a_report(tmp_path: Path) -> None:
    files.whole(tmp_path / "exp", still)
    made = viskill(
        "import", "official", "exp", "-o", "mine", "--subgoals", "scripted", cwd=tmp_path
    )
    assert made.returncode == 0, made.stderr
    assert "weights_ep20.pth" in made.stdout
    run = viskill("dry-run", "mine", "--no-video", "--json", "--output", "run", cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    result = json.loads(run.stdout)
    assert result["interventions"] == 0
    assert result["success_rate"] == 0.0, "a policy that keeps still does no task"
    (episode,) = result["episode_results"]
    assert [skill["steps"] for skill in episode["skills"]] == [45, 35, 20]
    assert "mine" in (tmp_path / "run" / "report.html").read_text()
    tips = read_recording(tmp_path / "run" / "recording").poses["/PSM1/measured_cp"].position
    assert np.ptp(tips, axis=0).max() == pytest.approx(0.0, abs=1e-4)


def test_a_policy_that_chooses_subgoals_far_away_is_stopped_and_says_why(tmp_path: Path) -> None:
    files.whole(tmp_path / "exp")  # untrained: its subgoals lie anywhere within 0.8 m
    assert viskill("import", "official", "exp", "-o", "mine", cwd=tmp_path).returncode == 0
    run = viskill("dry-run", "mine", "--no-video", "--output", "run", cwd=tmp_path)
    assert run.returncode == 5
    assert "outside the workspace of every arm" in run.stdout
    assert (tmp_path / "run" / "report.html").exists()
