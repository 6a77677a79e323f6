"""The command line as a new user meets it, each run a process of its own."""

import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaining import chain_graph, replace_file, value_graph
from typer.main import get_command
from typer.testing import CliRunner

from viskill_deploy.cli.main import app
from viskill_deploy.observe.reading import read_recording

ROOT = Path(__file__).resolve().parents[2]
BUNDLE = ROOT / "policies" / "bipegtransfer-viskill"
PROMISED = {
    "task",
    "episodes",
    "success_rate",
    "interventions",
    "rcm_error_max_m",
    "joint_margin_min",
    "tip_speed_max_m_s",
    "setpoints",
    "realtime_factor",
}


def viskill(*arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "viskill_deploy.cli.main", *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)


def figures(run: subprocess.CompletedProcess[str]) -> dict:
    assert run.returncode == 0, run.stderr
    assert run.stdout.count("\n") == 1, "--json prints one line and nothing else"
    return json.loads(run.stdout)


def test_a_dry_run_with_json_prints_the_promised_figures_and_leaves_its_evidence(
    tmp_path: Path,
) -> None:
    run = viskill("dry-run", BUNDLE, "--json", "--output", tmp_path / "run", cwd=tmp_path)
    result = figures(run)
    assert result.keys() >= PROMISED
    assert result["success_rate"] == 1.0
    assert result["interventions"] == 0
    assert result["rcm_error_max_m"] < 1e-9
    assert result["tip_speed_max_m_s"] < 0.05
    assert {len(entry["sha256"]) for entry in result["files"]} == {64}
    assert json.loads((tmp_path / "run" / "result.json").read_text()) == result
    page = (tmp_path / "run" / "report.html").read_text()
    assert "bipegtransfer" in page
    recording = read_recording(tmp_path / "run" / "recording")
    assert recording.complete
    files = [(entry["path"], entry["sha256"]) for entry in result["files"]]
    assert list(map(tuple, recording.about["files"])) == files
    cycles = len(recording.joints["/PSM1/setpoint_js"].time_s)
    assert 2 * cycles == result["setpoints"]
    assert len(recording.verdicts) >= cycles


@pytest.mark.no_cover
def test_the_same_seed_gives_the_same_run(tmp_path: Path) -> None:
    options = ("--no-video", "--json", "--seed", 3, "--distribution", "wide", "--output")
    first, second = (
        figures(viskill("dry-run", BUNDLE, *options, tmp_path / name, cwd=tmp_path))
        for name in "ab"
    )
    for key in PROMISED - {"realtime_factor"}:
        assert first[key] == second[key]
    assert first["margins"] == second["margins"]


@pytest.mark.no_cover
def test_plan_mode_streams_a_plan_that_was_checked_as_a_whole(tmp_path: Path) -> None:
    options = ("--mode", "plan", "--no-video", "--json", "--output", tmp_path / "run")
    result = figures(viskill("dry-run", BUNDLE, *options, cwd=tmp_path))
    assert result["mode"] == "plan"
    assert result["success_rate"] == 1.0
    assert result["interventions"] == 0


@pytest.mark.timeout(900)
@pytest.mark.quiet
def test_a_served_loopback_in_real_time_streams_setpoint_by_setpoint(tmp_path: Path) -> None:
    options = ("--realtime", "--rate", 100, "--no-video", "--json")
    run = viskill("dry-run", BUNDLE, *options, "--output", tmp_path / "run", cwd=tmp_path)
    result = json.loads(run.stdout)
    assert result["real_time"] is True
    assert result["setpoints"] > 0
    assert result["refused"] == 0
    # a machine that is busy with other tests may be too late for gate or watchdog, nothing else
    causes = {episode["stopped_by"] for episode in result["episode_results"]} - {""}
    assert causes <= {"S18", "S19", "S20", "S24", "S25"}
    assert run.returncode == (5 if causes else 0), run.stderr
    assert causes or result["success_rate"] == 1.0


def test_a_chaining_bundle_runs_through_the_whole_line_and_tells_what_it_decided(
    affinely_chained: Path, tmp_path: Path
) -> None:
    options = ("--episodes", 2, "--distribution", "wide", "--no-video", "--json")
    run = viskill("dry-run", affinely_chained, *options, "--output", tmp_path / "run", cwd=tmp_path)
    result = figures(run)
    assert result["success_rate"] == 1.0
    assert result["interventions"] == 0
    recording = read_recording(tmp_path / "run" / "recording", 1)
    recorded = [mark for mark in recording.marks if mark.subgoal]
    for told, mark in zip(result["episode_results"][1]["skills"], recorded, strict=True):
        assert told["name"] == mark.skill
        assert told["subgoal_source"] == mark.subgoal_source
        assert tuple(told["subgoal"]) == mark.subgoal
        assert told["value"] == mark.value
    assert [mark.subgoal_source for mark in recorded] == ["chaining", "chaining", "task"]
    page = (tmp_path / "run" / "report.html").read_text()
    assert "<h2>Subgoals</h2>" in page
    assert "below the bundle's threshold" not in run.stderr


@pytest.mark.no_cover
def test_low_values_and_refused_subgoals_are_told_in_plain_words(
    affinely_chained: Path, tmp_path: Path
) -> None:
    copy = shutil.copytree(affinely_chained, tmp_path / "lost")
    replace_file(copy, "chain-handover.onnx", chain_graph([0.0, 0.0, 0.3, 0.0, 0.0, 0.05]))
    run = viskill("dry-run", copy, "--no-video", "--output", tmp_path / "run", cwd=tmp_path)
    assert run.returncode == 5, run.stderr
    assert "222.9 mm outside the workspace" in run.stdout
    assert "Traceback" not in run.stderr
    plan = ("--mode", "plan", "--no-video", "--output", tmp_path / "plan")
    run = viskill("dry-run", copy, *plan, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    assert "refused: 1" in run.stdout
    assert "222.9 mm outside the workspace" in run.stdout
    replace_file(copy, "value-grasp.onnx", value_graph(0.25))
    run = viskill("dry-run", copy, "--no-video", "--output", tmp_path / "low", cwd=tmp_path)
    assert run.returncode == 0, run.stderr  # nothing was wrong: the runtime did not go on
    assert "\nsuccess: 0%\n" in run.stdout
    assert "before grasp: value 0.25 is below 0.50" in run.stdout
    assert "Traceback" not in run.stderr


UNDER_WAY_BYTES = 300_000
"""A recording as large as this holds motion."""


def _size(recording: Path) -> int:
    return sum(file.stat().st_size for file in recording.glob("*.mcap"))


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_brings_the_arms_to_rest_and_leaves_a_report(
    number: signal.Signals, tmp_path: Path
) -> None:
    command = [sys.executable, "-m", "viskill_deploy.cli.main", "dry-run", str(BUNDLE)]
    command += ["--episodes", "50", "--no-video", "--json", "--output", str(tmp_path / "run")]
    run = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    recording = tmp_path / "run" / "recording"
    while run.poll() is None and _size(recording) < UNDER_WAY_BYTES:
        pass
    run.send_signal(number)
    out, err = run.communicate(timeout=60)
    assert run.returncode == 130, err
    assert b"brought to rest" in err
    assert (tmp_path / "run" / "report.html").is_file()
    result = json.loads(out)
    assert 1 <= result["episodes"] < 50
    last = read_recording(recording).joints["/PSM1/setpoint_js"]
    assert np.abs(np.diff(last.position[-2:], axis=0)).max() < 1e-9


def test_a_changed_bundle_ends_with_exit_code_3_and_what_to_do(tmp_path: Path) -> None:
    copy = shutil.copytree(BUNDLE, tmp_path / "changed")
    graph = copy / "skill-grasp.onnx"
    content = bytearray(graph.read_bytes())
    content[len(content) // 2] ^= 1
    graph.write_bytes(bytes(content))
    for command in ("dry-run", "inspect"):
        run = viskill(command, copy, cwd=tmp_path)
        assert run.returncode == 3
        assert "skill-grasp.onnx" in run.stderr
        assert "fetch the bundle again" in run.stderr
        assert "Traceback" not in run.stderr


def test_a_safety_stop_ends_with_exit_code_5_and_a_report(tmp_path: Path) -> None:
    options = ("--insertion-noise", 0.3, "--no-video", "--output", tmp_path / "run")
    run = viskill("dry-run", BUNDLE, *options, cwd=tmp_path)
    assert run.returncode == 5, run.stderr
    assert "the gate stepped in" in run.stderr
    assert (tmp_path / "run" / "report.html").is_file()
    assert json.loads((tmp_path / "run" / "result.json").read_text())["interventions"] == 1


def test_a_missed_requirement_ends_with_exit_code_1(untrained_bundle: Path, tmp_path: Path) -> None:
    options = ("--require-success", 0.5, "--no-video", "--output", tmp_path / "run")
    run = viskill("dry-run", untrained_bundle, *options, cwd=tmp_path)
    assert run.returncode == 1
    assert "below the required" in run.stderr


@pytest.mark.parametrize(
    "arguments",
    [
        ("dry-run",),
        ("dry-run", BUNDLE, "--rate", 5),
        ("dry-run", BUNDLE, "--distribution", "elsewhere"),
        ("dry-run", BUNDLE, "--ik-solver", "magic"),
        ("dry-run", BUNDLE, "--mode", "hope"),
        ("dry-run", BUNDLE, "--output", __file__),
        ("no-such-command",),
    ],
)
def test_wrong_usage_ends_with_exit_code_2(arguments: tuple[object, ...]) -> None:
    run = CliRunner().invoke(app, [*map(str, arguments)])
    assert run.exit_code == 2
    assert "Traceback" not in run.output


def test_an_output_folder_that_holds_something_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("mine")
    run = viskill("dry-run", BUNDLE, "--output", tmp_path, cwd=tmp_path)
    assert run.returncode == 2
    assert (tmp_path / "precious").read_text() == "mine"


def test_inspect_and_doctor_speak_json(tmp_path: Path) -> None:
    manifest = figures(viskill("inspect", BUNDLE, "--json", cwd=tmp_path))
    assert manifest["task"] == "bipegtransfer"
    health = figures(viskill("doctor", "--json", cwd=tmp_path))
    assert health["problems"] == []
    assert len(health["data_files"]) >= 54


def test_doctor_says_where_own_files_go_before_the_folder_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = tmp_path / "own"
    monkeypatch.setenv("VISKILL_DATA", str(own))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "share"))
    run = CliRunner().invoke(app, ["doctor"])
    assert run.exit_code == 0
    assert f"data:    {own} (not there yet), " in run.stdout
    assert f"{tmp_path / 'share/viskill_deploy'} (not there yet), " in run.stdout
    assert "pip install 'viskill-deploy" not in run.stdout
    own.mkdir()
    found = json.loads(CliRunner().invoke(app, ["doctor", "--json"]).stdout)
    assert str(own) in found["data_roots"]
    assert str(own) not in found["data_roots_to_be"]


def test_inspect_shows_who_gives_subgoals_and_what_every_graph_takes(
    affinely_chained: Path, unchained: Path, tmp_path: Path
) -> None:
    run = viskill("inspect", affinely_chained, cwd=tmp_path)
    assert run.returncode == 0, run.stderr
    for text in ("chosen by the chaining policy", "low below 0.5", "chain-handover.onnx"):
        assert text in run.stdout
    assert "obs 35, task_goal 3, subgoal 8" in run.stdout
    assert "subgoal 6" in run.stdout
    run = viskill("inspect", unchained, cwd=tmp_path)
    assert "from the scripted plan" in run.stdout
    assert "chain-" not in run.stdout


def commands(group: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The words of every command."""
    if not hasattr(group, "commands"):
        yield words
        return
    for name, command in group.commands.items():
        yield from commands(command, (*words, name))


@pytest.mark.parametrize("words", [*commands(get_command(app))], ids=" ".join)
def test_every_command_has_help_with_an_example(words: tuple[str, ...]) -> None:
    run = CliRunner().invoke(app, [*words, "--help"])
    assert run.exit_code == 0
    assert "Example: viskill" in run.stdout
