"""Plan files from import to export and dry run: what they hold on to, and what they refuse."""

import json
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from viskill_deploy.cli.main import app
from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.errors import MotionError
from viskill_deploy.core.types import Waypoint
from viskill_deploy.motion.frames import Label
from viskill_deploy.motion.resolve import densified, resolve, start_seeds
from viskill_deploy.motion.trajectory import write_plan, written_of
from viskill_deploy.motion.waypoints import start_waypoint
from viskill_deploy.observe.trajectory_files import write_written
from viskill_deploy.runtime.trajectory import plan_waypoints

ROOT = Path(__file__).resolve().parents[2]
CELL = load_cell("bipegtransfer")


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def run(*arguments: object) -> SimpleNamespace:
    """A command in this process: whether it went well, its output, the sentence of an error."""
    ran = CliRunner().invoke(app, [str(a) for a in arguments])
    return SimpleNamespace(ok=ran.exit_code == 0, out=ran.output, error=str(ran.exception))


def moved(rows: int, step_m: float, cell: CellDescription = CELL) -> list[Waypoint]:
    """Both tips go along x from the start pose, 0.2 s a row."""
    start = start_waypoint(cell)
    way = []
    for i in range(rows):
        poses = [np.array(T) for T in start.T_task_tip]
        for T in poses:
            T[0, 3] += i * step_m
        way.append(Waypoint(tuple(poses), start.jaw, 0.2))
    return way


def write(name: str, waypoints: list[Waypoint], label: Label, cell: CellDescription = CELL) -> None:
    write_written(Path(name), written_of(cell, waypoints, label))


CRTK = Label("crtk", "jaw-pivot")


def lab_file(name: str) -> Path:
    """A cell whose PSM1 stands 20 mm from where the packaged one's does."""
    text = (ROOT / "robots/cells/bipegtransfer.toml").read_text(encoding="utf-8")
    text = text.replace("[-0.04293, 0.07364, 0.1553]", "[-0.06293, 0.07364, 0.1553]")
    text = text.replace('name = "bipegtransfer"', f'name = "{name}"')
    path = Path(f"{name}-lab.toml")
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("name", ["bipegtransfer", "mylab"])
def test_a_plan_is_followed_only_on_the_cell_that_it_was_made_for(name: str) -> None:
    file = lab_file(name)
    lab = load_cell(file)
    write("rows.csv", moved(3, 0.003, lab), CRTK, lab)
    assert run("import", "trajectory", "rows.csv", "-o", "a.plan.json", "--cell", file).ok
    assert str(Path.cwd()) not in Path("a.plan.json").read_text(encoding="utf-8")
    for command in (("export", "trajectory", "a.plan.json", "a.csv"), ("dry-run", "a.plan.json")):
        told = run(*command)
        assert not told.ok
        assert "--cell" in told.error
        other = run(*command, "--cell", "bipegtransfer")
        assert not other.ok
        assert "import the trajectory again" in other.error
    assert not Path("a.csv").exists()
    assert run("export", "trajectory", "a.plan.json", "a.csv", "--cell", file).ok
    assert (
        dry := run("dry-run", "a.plan.json", "--cell", file, "--no-video", "--output", "run")
    ).ok, dry.out
    file.write_text(file.read_text(encoding="utf-8").replace("-0.06293", "-0.06294"))
    changed = run("export", "trajectory", "a.plan.json", "b.csv", "--cell", file)
    assert "import the trajectory again" in changed.error


def test_a_plan_file_without_its_cells_digest_has_to_be_imported_again() -> None:
    write("rows.csv", moved(3, 0.003), CRTK)
    assert run("import", "trajectory", "rows.csv", "-o", "a.plan.json", "--cell", CELL.name).ok
    plan = Path("a.plan.json")
    plan.write_text(plan.read_text(encoding="utf-8").replace('"schema": 2', '"schema": 1'))
    old = run("export", "trajectory", "a.plan.json", "a.csv")
    assert "lacks the digest of its cell; import it again" in old.error


def test_a_recording_is_not_written_over() -> None:
    write("mine.csv", moved(3, 0.003), CRTK)
    kept = Path("mine.csv").read_bytes()
    command = ("import", "trajectory", "mine.csv", "--cell", CELL.name, "-o")
    other = run(*command, "mine.csv")
    assert not other.ok
    assert ".plan.json" in other.out
    assert run(*command, "plans/mine.plan.json").ok
    assert "exists" in run(*command, "plans/mine.plan.json").error
    assert "exists" in run("export", "trajectory", "plans/mine.plan.json", "mine.csv").error
    assert Path("mine.csv").read_bytes() == kept
    assert run("export", "trajectory", "plans/mine.plan.json", "joints/mine.csv").ok


@pytest.mark.parametrize("place", [1e300, 1e7, -0.1])
def test_a_plan_that_leads_out_of_the_workspace_is_neither_followed_nor_exported(
    place: float,
) -> None:
    write_plan(Path("a.plan.json"), CELL, moved(3, 0.003), "a test")
    plan = json.loads(Path("a.plan.json").read_text(encoding="utf-8"))
    plan["waypoints"][1]["position_m"][0][2] = place
    Path("a.plan.json").write_text(json.dumps(plan), encoding="utf-8")
    commands = [("dry-run", "a.plan.json"), ("export", "trajectory", "a.plan.json", "a.csv")]
    for command in [*commands, (*commands[1], "--waypoints")]:
        told = run(*command)
        assert not told.ok
        assert "outside the workspace of its arm" in told.error
    assert not Path("a.csv").exists()


@pytest.mark.parametrize("far_m", [1e4, 1e150])
def test_a_path_without_end_is_not_filled_with_waypoints(far_m: float) -> None:
    with pytest.raises(MotionError, match="too long"):
        densified(moved(2, far_m))


def test_an_import_tells_how_much_longer_than_its_file_the_plan_takes() -> None:
    write("rows.csv", moved(5, 0.02), CRTK)
    told = run("import", "trajectory", "rows.csv", "-o", "a.plan.json", "--cell", CELL.name)
    assert told.ok
    assert "8 waypoints were added" in told.out
    found = re.search(r"takes ([\d.]+) s from .*, ([\d.]+) x the 0.80 s", told.out)
    assert found
    assert float(found[2]) == pytest.approx(float(found[1]) / 0.8, abs=0.02)
    assert float(found[2]) > 3.0


def test_a_waypoint_out_of_reach_is_named_as_its_file_counts_it() -> None:
    rows = moved(5, 0.02)
    turned = [np.array(T) for T in rows[-1].T_task_tip]
    turned[0][:3, :3] = turned[0][:3, :3] @ np.diag([1.0, -1.0, -1.0])  # points upwards
    write("rows.csv", [*rows[:-1], replace(rows[-1], T_task_tip=tuple(turned))], CRTK)
    told = run("import", "trajectory", "rows.csv", "-o", "a.plan.json", "--cell", CELL.name)
    assert re.search(r"rows.csv: waypoint 5 of 5 is out of PSM1's reach", told.error)


def test_a_step_that_cannot_be_made_is_said_to_be_counted_with_the_waypoints_added() -> None:
    rows = moved(2, 0.02)
    rows[1] = replace(rows[1], jaw=(3.0, 0.0))
    home = resolve(CELL, [start_waypoint(CELL)], start_seeds(CELL))[1]
    with pytest.raises(MotionError, match="rows, counted with the 2 waypoints that were added: st"):
        plan_waypoints(CELL, rows, home, source="rows")


def test_a_waypoint_out_of_the_reach_of_an_own_arm_is_named_as_its_file_counts_it() -> None:
    body = load_cell("bodytrainer")
    home = resolve(body, [start_waypoint(body)], start_seeds(body))[1]
    with pytest.raises(MotionError, match="rows: ARM1, waypoint 2 of 2: "):
        plan_waypoints(body, moved(2, 0.5, body), home, source="rows")
