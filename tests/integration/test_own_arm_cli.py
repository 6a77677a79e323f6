"""A trajectory for an arm of a lab's own, from a file of waypoints to a report with a video."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from viskill_deploy.cli.main import app
from viskill_deploy.observe.reading import read_recording

DOWN = "0.7071067811865476,-0.7071067811865476,0,0"
"""x, y, z, w of a tip that points straight down, yaw 0."""


def run(*arguments: object) -> str:
    ran = CliRunner().invoke(app, [str(a) for a in arguments])
    assert ran.exit_code == 0, ran.exception or ran.output
    return ran.stdout


@pytest.fixture
def plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    columns = ",".join(f"ARM1.{c}" for c in ("x", "y", "z", "qx", "qy", "qz", "qw", "jaw"))
    places = [("0", "0", "0.06"), ("0.02", "0.01", "0.05"), ("0.02", "-0.01", "0.05")]
    rows = [f"{','.join(place)},{DOWN},0.2" for place in places]
    text = "\n".join(["# frame: task", "# control_point: jaw-pivot", columns, *rows]) + "\n"
    (tmp_path / "path.csv").write_text(text, encoding="utf-8")
    run("import", "trajectory", "path.csv", "-o", "mine.plan.json", "--cell", "bodytrainer")
    return tmp_path / "mine.plan.json"


def test_waypoints_are_imported_dry_run_recorded_and_exported(plan: Path) -> None:
    out = run("dry-run", plan, "--no-video", "--json", "--output", "run")
    result = json.loads(out)
    assert (result["success_rate"], result["interventions"]) == (1.0, 0)
    assert result["rcm_error_max_m"] < 1e-4
    assert result["margins"]["S12"] > 0.9
    data = read_recording(plan.parent / "run" / "recording")
    track = data.joints["/ARM1/measured_js"]
    assert track.position.shape[1] == len(data.about["joints"]) == 7
    tip = data.poses["/ARM1/measured_cp"].position
    assert np.allclose(tip[-1], (0.02, -0.01, 0.05), atol=2e-4)
    page = (plan.parent / "run" / "report.html").read_text(encoding="utf-8")
    assert '"a7' in page or ">a7" in page
    run("export", "trajectory", plan, "joints.csv")
    table = np.loadtxt(plan.parent / "joints.csv", delimiter=",", skiprows=1)
    assert np.isfinite(table).all()


def test_convert_says_which_joints_a_pose_asks_for(plan: Path) -> None:
    told = ("convert", "--cell", "bodytrainer", "--arm", "ARM1", "--frame", "task")
    told = (*told, "--control-point", "jaw-pivot", "--json", "--rpy", 180, 0, 90)
    shown = json.loads(run(*told, "--", 0.01, 0.0, 0.05))
    assert list(shown["joints"]) == [f"a{i}" for i in range(1, 8)]
    assert json.loads(run(*told, "--", 0.0, 0.0, 0.2))["problem"]
