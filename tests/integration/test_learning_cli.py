"""Sweeps, training, evaluation and tables as commands, with a method that hardly learns."""

import contextlib
import dataclasses
import errno
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from viskill_deploy.cli import main
from viskill_deploy.cli.main import app
from viskill_deploy.core.errors import TrainingError
from viskill_deploy.train.curves import read_log
from viskill_deploy.train.results import read_result

SETTINGS = """
environments = 1
demos = { episodes = 1, corrected = 1 }
dex = { batch = 8, hidden = 16, critic_first = 1 }
amounts = { planned_rounds = 1, rounds = 2 }
[skill]
imitation_steps = 20
polish_steps = 1
corrections = 0
rounds = 0
updates = 1
test_every = 1
"""

SWEEP = """
output = "runs"
results = "results"
processes = 1
[measuring]
episodes = 1
[[units]]
tasks = ["bipegtransfer"]
methods = ["dex"]
seeds = [0]
[settings]
""" + SETTINGS.strip().replace("[skill]", "[settings.skill]")

FOLDER = Path("runs/bipegtransfer/seed0")


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "viskill_deploy.cli.main", *map(str, arguments)]


def viskill(*arguments: object) -> Any:
    """A command in this process, which has torch loaded already."""
    return CliRunner().invoke(app, list(map(str, arguments)))


def child_of(process: subprocess.Popen[str]) -> int:
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            parent = path.read_text().rpartition(")")[2].split()[1]
            if int(parent) == process.pid:
                return int(path.parent.name)
    raise AssertionError("the sweep runs no unit")


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, str]:
    """A sweep whose unit was killed in the middle of its learning; what it printed."""
    cwd = tmp_path_factory.mktemp("sweep")
    (cwd / "sweep.toml").write_text(SWEEP, encoding="utf-8")
    process = subprocess.Popen(
        command("sweep", "sweep.toml", "--json"),
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    while not (cwd / FOLDER / "dex.state.npz").is_file() and process.poll() is None:
        time.sleep(0.01)
    os.kill(child_of(process), signal.SIGKILL)
    out, err = process.communicate(timeout=200)
    assert process.returncode == 0, err
    return cwd, out, err


@pytest.mark.no_cover
def test_a_unit_that_is_killed_is_started_again_and_goes_on_where_it_was(
    swept: tuple[Path, str, str],
) -> None:
    cwd, out, err = swept
    (unit,) = json.loads(out)["units"]
    assert (unit["status"], unit["attempts"]) == ("finished", 2)
    assert "died, started once more" in err
    result = read_result(cwd / "results" / "bipegtransfer-dex-seed0.json")
    assert set(result.scores) == {"reference", "wide"}
    rounds = result.training.curves["dex"]["round"]
    assert rounds == [0.0, 1.0, 2.0]
    lines = (cwd / FOLDER / "log.jsonl").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= len(read_log(cwd / FOLDER)) + 1, "one round at most was done twice"
    assert (cwd / FOLDER / "curves.png").is_file()


def test_a_finished_sweep_has_nothing_left_to_do(
    swept: tuple[Path, str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(swept[0])
    run = viskill("sweep", "sweep.toml", "--json")
    assert run.exit_code == 0, run.output
    assert [unit["status"] for unit in json.loads(run.stdout)["units"]] == ["skipped"]


def test_tables_are_built_from_the_results(
    swept: tuple[Path, str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(swept[0])
    run = viskill("reproduce", "results", "-o", "page.md")
    assert run.exit_code == 0, run.output
    assert run.stdout.split() == ["page.md", "page-value.svg"]
    assert viskill("reproduce", "results", "--json").exit_code == 2
    assert viskill("reproduce", "results", "--deployment", "--sweep", "x").exit_code == 2
    run = viskill("reproduce", "results")
    assert run.stdout.split() == ["reproduction.md", "reproduction-value.svg"]
    assert "| DEX | 1 x 1 episodes | 14.03 |" in Path("page.md").read_text("utf-8")


def test_a_learned_method_can_be_evaluated_by_itself(swept: tuple[Path, str, str]) -> None:
    folder = swept[0] / FOLDER
    options = ("--episodes", 1, "--distribution", "wide", "--seed", 5, "--json")
    run = viskill("evaluate", folder, *options)
    assert run.exit_code == 0, run.output
    told = json.loads(run.stdout)
    assert (told["method"], told["layout_seed"], set(told["scores"])) == ("dex", 5, {"wide"})
    told = json.loads(viskill("evaluate", folder, "--episodes", 1, "--json").stdout)
    measured = read_result(folder / "dex" / "result.json").scores
    assert told["scores"] == {name: dataclasses.asdict(f) for name, f in measured.items()}
    for wrong in (("--method", "viskill"), ("--distribution", "elsewhere")):
        assert viskill("evaluate", folder, *wrong).exit_code == 2


def test_training_goes_on_in_the_same_folder_and_refuses_another_run(
    swept: tuple[Path, str, str], tmp_path: Path
) -> None:
    settings = tmp_path / "run.toml"
    settings.write_text(SETTINGS, encoding="utf-8")
    options = ("--settings", settings, "--output", swept[0] / FOLDER)
    run = viskill("train", "bipegtransfer", "--method", "dex", *options)
    assert run.exit_code == 0, run.output
    assert "learned: demos" in run.stdout
    assert f"viskill evaluate {swept[0] / FOLDER} --method dex" in run.stdout
    run = viskill("train", "bipegtransfer", "--method", "dex", *options, "--environments", 2)
    assert isinstance(run.exception, TrainingError)
    assert "empty folder" in str(run.exception)
    assert viskill("train", "bipegtransfer", "--method", "magic", *options).exit_code == 2


@pytest.mark.no_cover
def test_what_a_path_or_a_disk_refuses_is_no_bug(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    run = subprocess.run(
        command("train", "bipegtransfer", "--output", file),
        check=False,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 3
    assert f"{file}: File exists; name another path" in run.stderr
    assert "bug" not in run.stderr


@pytest.mark.parametrize(
    ("error", "advice"),
    [
        (OSError(errno.ENOSPC, "full"), "make room"),
        (OSError(errno.EACCES, "denied", "a/path"), "name another path"),
        (OSError(errno.EPERM, "not permitted"), None),
        (OSError(errno.ENOENT, "none", "a/path"), None),
    ],
)
def test_advice_is_given_where_there_is_some(error: OSError, advice: str | None) -> None:
    told = main._advice(error)
    assert told is None if advice is None else advice in str(told)
