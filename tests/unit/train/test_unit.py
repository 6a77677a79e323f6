"""Units with a method that learns to count, in place of the real ones."""

import fcntl
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from viskill_deploy.core.errors import DataFileError, TrainingError
from viskill_deploy.train import methods, unit
from viskill_deploy.train.evaluate import Score
from viskill_deploy.train.lock import alone
from viskill_deploy.train.results import Figures, Measuring, Unit, figures_of, read_result
from viskill_deploy.train.run import Run
from viskill_deploy.train.settings import RunSettings

ROOT = Path(__file__).resolve().parents[3]
UNIT = Unit("bipegtransfer", "counting", 0)


class Counting:
    """A learner that adds one a round, up to `rounds`."""

    def __init__(self, rounds: int = 4) -> None:
        self.rounds, self.count = rounds, 0

    @property
    def finished(self) -> bool:
        return self.count >= self.rounds

    def advance(self) -> dict[str, float]:
        self.count += 1
        return {"round": float(self.count - 1), "success": self.count / self.rounds}

    def state(self) -> dict[str, Any]:
        return {"count": self.count}

    def restore(self, tree: dict[str, Any]) -> None:
        self.count = tree["count"]


class Method:
    """A method in the place of a file in `methods`."""

    NEEDS_SKILLS = False

    @staticmethod
    def learn(run: Run) -> object:
        if not run.done("counting"):
            learner = Counting()
            run.learn("counting", learner)
            run.finish("counting", learner.state())
        return object()


@pytest.fixture
def evaluated(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[tuple[Any, ...]]]:
    """Puts the counting method in place; what evaluation was asked."""
    asked: list[tuple[Any, ...]] = []

    def evaluate(loop: object, policy: object, *rest: Any) -> Score:
        asked.append(rest)
        return Score(rest[0], rest[1], 0.5, 1.5, float("nan"), {"grasp": 1.0})

    monkeypatch.setattr(methods, "_module", lambda _: Method)
    monkeypatch.setattr(unit, "demos_of", lambda run: run.done("demos"))
    monkeypatch.setattr(unit, "evaluate", evaluate)
    monkeypatch.setattr(Run, "loop", None)
    yield asked


def done(root: Path, settings: RunSettings | None = None, episodes: int = 7) -> list[str]:
    said: list[str] = []
    unit.do_unit(UNIT, root, settings or RunSettings(), Measuring(episodes), say=said.append)
    return said


def test_a_unit_leaves_a_result_with_everything_that_tables_need(
    tmp_path: Path, evaluated: list[tuple[Any, ...]]
) -> None:
    done(tmp_path)
    folder = tmp_path / "bipegtransfer" / "seed0"
    result = read_result(folder / "counting" / "result.json")
    assert result.unit == UNIT
    assert result.scores == {
        name: Figures(7, 0.5, 1.5, None, {"grasp": 1.0}) for name in ("reference", "wide")
    }
    assert evaluated == [("reference", 7, 0), ("wide", 7, 0)]
    assert result.calibration is None
    training = result.training
    assert training.curves["counting"]["success"] == [0.25, 0.5, 0.75, 1.0]
    assert set(training.seconds) == {"counting"}
    assert training.peak_memory_mib > 50
    assert {"python", "torch", "mujoco"} <= set(training.versions)
    assert training.stages == {"counting": training.commit}
    assert result.settings["environments"] == RunSettings().environments
    assert (folder / "curves.png").is_file()
    assert (folder / "tensorboard" / "counting").is_dir()
    assert unit.learned(folder) == ["counting"]


def test_a_unit_that_is_done_does_nothing(tmp_path: Path, evaluated: list[tuple[Any, ...]]) -> None:
    assert done(tmp_path)
    assert done(tmp_path) == []
    assert len(evaluated) == 2


def test_a_result_with_other_settings_is_refused(
    tmp_path: Path, evaluated: list[tuple[Any, ...]]
) -> None:
    done(tmp_path)
    with pytest.raises(TrainingError, match="other settings"):
        done(tmp_path, episodes=8)
    with pytest.raises(TrainingError, match="other settings"):
        done(tmp_path, RunSettings(environments=3))


def test_a_damaged_result_says_how_to_get_it_again(
    tmp_path: Path, evaluated: list[tuple[Any, ...]]
) -> None:
    done(tmp_path)
    path = UNIT.run_folder(tmp_path) / "counting" / "result.json"
    path.write_text(path.read_text()[:99])
    with pytest.raises(DataFileError, match="delete it and run its unit again"):
        done(tmp_path)
    path.unlink()
    assert not any("stage counting" in line for line in done(tmp_path))
    assert path.is_file()


def test_two_processes_do_not_measure_the_same_unit(
    tmp_path: Path, evaluated: list[tuple[Any, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = UNIT.run_folder(tmp_path) / "counting" / "result.json"
    evaluate, held = unit.evaluate, []

    def alone_with_it(*asked: Any) -> Score:
        with path.with_name("measuring.lock").open("a") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                held.append(True)
        return evaluate(*asked)

    monkeypatch.setattr(unit, "evaluate", alone_with_it)
    done(tmp_path)
    assert held == [True, True]
    known, late = unit.finished, iter([None])  # who looked before the first had written
    monkeypatch.setattr(unit, "finished", lambda *asked: next(late, known(*asked)))
    done(tmp_path)
    assert len(evaluated) == 2


def test_a_unit_that_was_stopped_while_it_was_measured_is_not_learned_again(
    tmp_path: Path, evaluated: list[tuple[Any, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stops(*_: object) -> Score:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(unit, "evaluate", stops)
        with pytest.raises(KeyboardInterrupt):
            done(tmp_path)
    said = done(tmp_path)
    assert not any("stage counting" in line for line in said)
    assert len(evaluated) == 2


def test_curves_are_drawn_even_if_a_process_died_just_before(
    tmp_path: Path, evaluated: list[tuple[Any, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stops(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(unit.curves, "draw", stops)
        with pytest.raises(KeyboardInterrupt):
            done(tmp_path)
    folder = UNIT.run_folder(tmp_path)
    assert (folder / "counting.npz").is_file()
    done(tmp_path)
    assert (folder / "curves.png").is_file()
    assert (folder / "tensorboard" / "counting").is_dir()


def test_stages_of_another_method_in_the_same_run_are_not_counted(
    tmp_path: Path, evaluated: list[tuple[Any, ...]]
) -> None:
    folder = UNIT.run_folder(tmp_path)
    folder.mkdir(parents=True)
    line = {"stage": "dex", "round": 0.0, "success": 0.1, "seconds": 99.0}
    (folder / "log.jsonl").write_text(json.dumps(line) + "\n", encoding="utf-8")
    done(tmp_path)
    result = read_result(folder / "counting" / "result.json")
    assert set(result.training.curves) == {"counting"}


def test_a_rollout_length_that_is_no_number_becomes_none() -> None:
    score = Score("wide", 3, 0.0, 0.0, float("nan"), {})
    assert figures_of(score).rollout_length is None
    score = Score("wide", 3, 1.0, 3.0, 61.5, {})
    assert figures_of(score).rollout_length == 61.5


KILLED = """
import sys, time
sys.path[:0] = {paths!r}
from pathlib import Path
import test_unit
from viskill_deploy.train import methods, unit
from viskill_deploy.train.results import Measuring
from viskill_deploy.train.run import Run
from viskill_deploy.train.settings import RunSettings

slow = test_unit.Counting.advance
def advance(self):
    time.sleep(0.2)
    return slow(self)
test_unit.Counting.advance = advance
methods._module = lambda _: test_unit.Method
unit.demos_of = lambda run: run.done("demos")
unit.do_unit(test_unit.UNIT, Path({root!r}), RunSettings(), Measuring())
"""


def test_a_unit_that_was_killed_goes_on_from_its_last_checkpoint(
    tmp_path: Path, evaluated: list[tuple[Any, ...]]
) -> None:
    code = KILLED.format(paths=[str(Path(__file__).parent), str(ROOT)], root=str(tmp_path))
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.DEVNULL)
    folder = UNIT.run_folder(tmp_path)
    checkpoint = folder / "counting.state.npz"
    while not checkpoint.is_file() and process.poll() is None:
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert not (folder / "counting" / "result.json").exists()
    said = done(tmp_path)  # the dead process holds no lock
    assert not any("round 0" in line for line in said)
    result = read_result(folder / "counting" / "result.json")
    assert result.training.curves["counting"]["success"] == [0.25, 0.5, 0.75, 1.0]


WAITING = """
import sys
from pathlib import Path
from viskill_deploy.train.lock import alone
with alone(Path(sys.argv[1]), lambda line: print(line, flush=True)):
    print("alone", flush=True)
"""


def test_a_lock_makes_a_second_process_wait_and_says_so(tmp_path: Path) -> None:
    said: list[str] = []
    lock = tmp_path / "deep" / "lock"
    with alone(lock, said.append):
        second = subprocess.Popen(
            [sys.executable, "-c", WAITING, str(lock)],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
        assert second.stdout is not None
        assert second.stdout.readline().startswith("waits for another process")
        assert second.poll() is None
    assert second.communicate(timeout=60)[0] == "alone\n"
    assert said == []


def test_the_unit_as_a_command_says_what_is_wrong(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = tmp_path / "run.json"
    settings.write_text('{"environment": 3}', encoding="utf-8")
    arguments = ["bipegtransfer", "dex", "0", str(tmp_path), "--settings", str(settings)]
    assert unit.main(arguments) == 3
    assert "environment" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        unit.main(["bipegtransfer", "magic", "0", str(tmp_path)])
