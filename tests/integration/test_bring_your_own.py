"""Policies and trajectories that were made elsewhere, from their files to a report.

Dry runs are processes of their own; the other commands run in this one, to save their start.
"""

import json
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import official_files as files
import pytest
from typer.testing import CliRunner

from viskill_deploy.cli.main import app
from viskill_deploy.core.errors import ViskillError
from viskill_deploy.observe.reading import read_recording


def viskill(*arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "viskill_deploy.cli.main", *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)


def here(*arguments: object, cwd: Path, monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A command in this process: return code, output, and the sentence of an error."""
    with monkeypatch.context() as context:
        context.chdir(cwd)
        ran = CliRunner().invoke(app, [str(a) for a in arguments])
    error = ran.exception
    code = error.exit_code if isinstance(error, ViskillError) else ran.exit_code
    return SimpleNamespace(returncode=code, stdout=ran.stdout, stderr=str(error))


def still(key: str, shape: tuple[int, ...]) -> np.ndarray:
    """Weights of a policy that keeps still, jaws closed."""
    values = np.zeros(shape, dtype=np.float32)
    if key.endswith("actor.trunk.mlp.6.bias"):
        values[4::5] = -5.0
    return values


def test_official_checkpoints_go_through_the_whole_line_to_a_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files.whole(tmp_path / "exp", still)
    made = here(
        *("import", "official", "exp", "-o", "mine", "--subgoals", "scripted"),
        cwd=tmp_path,
        monkeypatch=monkeypatch,
    )
    assert made.returncode == 0, made.stderr
    assert made.stdout.count("weights_ep10.pth") == 3, "the skills, and no chaining policy"
    assert "weights_ep20.pth" not in made.stdout
    run = viskill("dry-run", "mine", "--no-video", "--json", "--output", "run", cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    result = json.loads(run.stdout)
    assert result["interventions"] == 0
    assert result["success_rate"] == 0.0, "a policy that keeps still does no task"
    (episode,) = result["episode_results"]
    assert episode["skills"][0]["steps"] == 45, "then nothing is held, and the run knows it"
    assert "mine" in (tmp_path / "run" / "report.html").read_text()
    tips = read_recording(tmp_path / "run" / "recording").poses["/PSM1/measured_cp"].position
    assert np.ptp(tips, axis=0).max() == pytest.approx(0.0, abs=1e-4)


def test_a_policy_that_chooses_subgoals_far_away_is_stopped_and_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files.whole(tmp_path / "exp")  # untrained: its subgoals lie anywhere within 0.8 m
    made = here("import", "official", "exp", "-o", "mine", cwd=tmp_path, monkeypatch=monkeypatch)
    assert made.returncode == 0, made.stderr
    run = viskill("dry-run", "mine", "--no-video", "--output", "run", cwd=tmp_path)
    assert run.returncode == 5
    assert "outside the workspace of every arm" in run.stdout
    assert (tmp_path / "run" / "report.html").exists()


def test_waypoints_of_surrol_become_a_plan_that_is_dry_run_and_exported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [f"{a}.{c}" for a in ("PSM1", "PSM2") for c in ("x", "y", "z", "roll", "pitch", "yaw")]
    rows = []
    for i in range(6):  # both tips go 12 mm away from the columns, jaws stay closed
        x, turns = 2.5 + 5 * 0.0024 * i, "-1.5707963267948966,0,1.5707963267948966"
        rows.append(f"{x},0.25,3.776,{turns},{x},-0.25,3.776,{turns},0,0")
    head = ",".join([*names, "PSM1.jaw", "PSM2.jaw"])
    (tmp_path / "surrol.csv").write_text("\n".join([head, *rows]) + "\n")
    told = ("--cell", "bipegtransfer", "--frame", "surrol", "--control-point")
    command = ("import", "trajectory", "surrol.csv", "-o", "mine.plan.json", *told)
    wrong = here(*command, "jaw-end", cwd=tmp_path, monkeypatch=monkeypatch)
    assert wrong.returncode == 3
    assert "likely it is about the jaw-pivot (10.2 mm)" in wrong.stderr
    silent = here(*command[:-1], cwd=tmp_path, monkeypatch=monkeypatch)
    assert silent.returncode == 2
    assert here(*command, "jaw-pivot", cwd=tmp_path, monkeypatch=monkeypatch).returncode == 0
    run = viskill(
        "dry-run", "mine.plan.json", "--no-video", "--json", "--output", "run", cwd=tmp_path
    )
    assert run.returncode == 0, run.stderr
    result = json.loads(run.stdout)
    assert result["mode"] == "trajectory"
    assert result["success_rate"] == 1.0
    assert result["interventions"] == 0
    track = read_recording(tmp_path / "run" / "recording").poses["/PSM1/measured_cp"]
    assert track.position[-1] - track.position[0] == pytest.approx([0.012, 0, 0], abs=2e-4)
    made = here(
        "export",
        "trajectory",
        "mine.plan.json",
        "joints.csv",
        cwd=tmp_path,
        monkeypatch=monkeypatch,
    )
    assert made.returncode == 0, made.stderr
    table = np.loadtxt(tmp_path / "joints.csv", delimiter=",", skiprows=1)
    assert table[-1, 0] == pytest.approx(result["simulated_s"], abs=0.3)
    made = here(
        "export", "trajectory", "mine.plan.json", "bag", "--waypoints", "--frame", "crtk",
        cwd=tmp_path, monkeypatch=monkeypatch,
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    again = ("import", "trajectory", "bag", "-o", "again.plan.json", "--cell", "bipegtransfer")
    assert here(*again, cwd=tmp_path, monkeypatch=monkeypatch).returncode == 0, (
        "the bag says what its numbers mean"
    )
    assert here(*again, "--frame", "rcm", cwd=tmp_path, monkeypatch=monkeypatch).returncode == 2


def test_convert_shows_a_pose_in_every_frame(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = ("convert", "--cell", "bipegtransfer", "--arm", "PSM1", "--frame", "surrol")
    told = (*told, "--control-point", "jaw-pivot", "--json", "--rpy", -90, 0, 90)
    run = here(*told, "--", 2.5, 0.25, 3.776, cwd=tmp_path, monkeypatch=monkeypatch)
    assert run.returncode == 0, run.stderr
    shown = json.loads(run.stdout)
    poses = {(row["frame"], row["control_point"]): row["position"] for row in shown["poses"]}
    assert len(poses) == 10
    assert poses["world", "jaw-end"] == pytest.approx([0.5, 0.05, 0.745], abs=1e-12)
    assert shown["joints"]["insertion"] == pytest.approx(0.10681, abs=2e-5)
    assert not shown["problem"]
    far = here(*told, "--", 2.5, 0.25, 1.0, cwd=tmp_path, monkeypatch=monkeypatch)
    assert json.loads(far.stdout)["problem"]
    for place in (("nan", 0, 0), ("inf", 0, 0), (1e308, 0, 0)):
        assert here(*told, "--", *place, cwd=tmp_path, monkeypatch=monkeypatch).returncode == 2
    turned = (*told, "--rpy", "nan", 0, 0, "--", 1, 2, 3)
    assert here(*turned, cwd=tmp_path, monkeypatch=monkeypatch).returncode == 2
    assert (
        here(
            *told, "--arm", "PSM3", "--", 1, 2, 3, cwd=tmp_path, monkeypatch=monkeypatch
        ).returncode
        == 2
    )
