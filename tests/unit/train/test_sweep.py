"""The pool of a sweep, with small scripts in place of units."""

import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from result_files import result

from viskill_deploy.core.errors import TrainingError
from viskill_deploy.train import sweep as pool
from viskill_deploy.train.results import Measuring, Unit, read_result, write_result
from viskill_deploy.train.settings import RunSettings
from viskill_deploy.train.sweep import Outcome, Pool, last_line, unit_command
from viskill_deploy.train.sweep_file import Sweep

VISKILL, TSTAR, GCBC = (Unit("bipegtransfer", m, 0) for m in ("viskill", "tstar", "gcbc"))
OTHER = Unit("bipegtransfer", "viskill", 1)

FAKE = """
import pathlib, shutil, sys
folder, source, todo = map(pathlib.Path, sys.argv[1:])
print("at work", flush=True)
{extra}
shutil.copyfile(source, folder / "result.json")
"""

Make = Callable[..., Sweep]


class Notes:
    """Writes down what it is told."""

    def __init__(self) -> None:
        self.begun: list[tuple[str, int]] = []
        self.ended: list[Outcome] = []
        self.lines: set[str] = set()

    def started(self, unit: Unit, attempt: int) -> None:
        self.begun.append((unit.name, attempt))

    def says(self, unit: Unit, line: str) -> None:
        self.lines.add(line)

    def over(self, outcome: Outcome) -> None:
        self.ended.append(outcome)


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Make:
    """A sweep of some units whose results lie ready."""
    monkeypatch.setattr(pool, "POLL_S", 0.02)

    def of(*some: Unit, processes: int = 2) -> Sweep:
        for unit in some:
            made = result(unit.task, unit.method, unit.seed, 0.9)
            write_result(tmp_path / "ready" / f"{unit.name}.json", made)
        settings = {unit.task: RunSettings() for unit in some}
        output, results = tmp_path / "runs", tmp_path / "results"
        return Sweep(some, settings, Measuring(), output, results, processes)

    return of


def scripts(tmp_path: Path, extra: str = "") -> pool.Command:
    """Commands that copy the ready result after doing `extra`."""

    def command(sweep: Sweep, unit: Unit) -> list[str]:
        folder = unit.run_folder(sweep.output) / unit.method
        ready = tmp_path / "ready" / f"{unit.name}.json"
        code = FAKE.format(extra=extra)
        return [sys.executable, "-c", code, str(folder), str(ready), str(tmp_path)]

    return command


def test_every_unit_is_run_and_its_result_copied(make: Make, tmp_path: Path) -> None:
    notes, wait = Notes(), "import time; time.sleep(0.3)"
    outcomes = Pool(make(VISKILL, OTHER), notes, scripts(tmp_path, wait)).run()
    assert {(o.unit, o.status, o.attempts) for o in outcomes} == {
        (VISKILL, "finished", 1),
        (OTHER, "finished", 1),
    }
    assert notes.ended == outcomes
    assert "at work" in notes.lines
    copies = sorted((tmp_path / "results").iterdir())
    assert [path.name for path in copies] == [f"{u.name}.json" for u in (VISKILL, OTHER)]
    assert read_result(copies[0]).unit == VISKILL


def test_a_unit_that_dies_is_started_once_more(make: Make, tmp_path: Path) -> None:
    die_once = (
        "mark = todo / ('died-' + folder.name)\n"
        "if not mark.exists():\n"
        "    mark.touch()\n"
        "    import os; os.kill(os.getpid(), 9)\n"
    )
    notes = Notes()
    (outcome,) = Pool(make(VISKILL), notes, scripts(tmp_path, die_once)).run()
    assert (outcome.status, outcome.attempts) == ("finished", 2)
    assert notes.begun == [(VISKILL.name, 1), (VISKILL.name, 2)]
    assert outcome.log.read_text().count("at work") == 2


@pytest.mark.parametrize("extra", ["sys.exit('no luck')", "sys.exit(0)"])
def test_a_unit_that_fails_twice_is_reported_and_the_others_go_on(
    extra: str, make: Make, tmp_path: Path
) -> None:
    bad = f"if folder.name == 'tstar': {extra}"
    outcomes = Pool(make(TSTAR, OTHER), Notes(), scripts(tmp_path, bad)).run()
    assert {(o.unit, o.status, o.attempts) for o in outcomes} == {
        (TSTAR, "failed", 2),
        (OTHER, "finished", 1),
    }
    assert not (tmp_path / "results" / f"{TSTAR.name}.json").exists()


def test_a_finished_unit_is_skipped(make: Make, tmp_path: Path) -> None:
    sweep, notes = make(VISKILL, OTHER), Notes()
    folder = VISKILL.run_folder(sweep.output) / "viskill"
    write_result(folder / "result.json", result("bipegtransfer", "viskill", 0, 0.9))
    outcomes = Pool(sweep, notes, scripts(tmp_path)).run()
    assert [(o.unit, o.status) for o in outcomes] == [(VISKILL, "skipped"), (OTHER, "finished")]
    assert notes.begun == [(OTHER.name, 1)]
    assert (tmp_path / "results" / f"{VISKILL.name}.json").is_file()


def test_a_result_of_other_settings_is_not_taken_for_this_sweeps(make: Make) -> None:
    sweep = make(VISKILL)
    folder = VISKILL.run_folder(sweep.output) / "viskill"
    write_result(folder / "result.json", result("bipegtransfer", "viskill", 0, 0.9))
    with pytest.raises(TrainingError, match="other settings"):
        Pool(replace(sweep, measuring=Measuring(episodes=7)), Notes()).run()


def test_a_result_from_elsewhere_is_not_written_over(make: Make, tmp_path: Path) -> None:
    sweep, notes = make(VISKILL, OTHER), Notes()
    copy = tmp_path / "results" / f"{VISKILL.name}.json"
    write_result(copy, replace(result("bipegtransfer", "viskill", 0, 0.1), measuring=Measuring(7)))
    before = copy.read_bytes()
    with pytest.raises(TrainingError, match="name another folder for `results`"):
        Pool(sweep, notes, scripts(tmp_path)).run()
    assert notes.begun == []
    assert copy.read_bytes() == before


def test_a_result_that_cannot_be_copied_fails_that_unit_alone(make: Make, tmp_path: Path) -> None:
    sweep = make(VISKILL, OTHER)
    (tmp_path / "results" / f"{VISKILL.name}.json").mkdir(parents=True)  # in the way
    outcomes = Pool(sweep, Notes(), scripts(tmp_path)).run()
    assert {(o.unit, o.status) for o in outcomes} == {(VISKILL, "failed"), (OTHER, "finished")}
    failed = next(o for o in outcomes if o.unit == VISKILL)
    assert "could not be copied" in failed.log.read_text()
    assert [path.name for path in (tmp_path / "results").iterdir() if path.is_file()] == [
        f"{OTHER.name}.json"
    ]


def test_a_damaged_result_fails_its_unit_and_no_other(make: Make, tmp_path: Path) -> None:
    sweep = make(VISKILL, OTHER)
    bad = VISKILL.run_folder(sweep.output) / "viskill" / "result.json"
    bad.parent.mkdir(parents=True)
    bad.write_text("{")
    stays = "if folder.name == 'viskill' and 'seed0' in str(folder): sys.exit('damaged')"
    outcomes = Pool(sweep, Notes(), scripts(tmp_path, stays)).run()
    assert {(o.unit, o.status) for o in outcomes} == {(VISKILL, "failed"), (OTHER, "finished")}
    assert bad.read_text() == "{"


def test_what_a_unit_said_before_stays_in_its_log(make: Make, tmp_path: Path) -> None:
    sweep = make(VISKILL)
    log = VISKILL.run_folder(sweep.output) / "viskill" / "unit.log"
    log.parent.mkdir(parents=True)
    log.write_text("of before\n")
    Pool(sweep, Notes(), scripts(tmp_path)).run()
    assert log.read_text() == f"of before\nsweep: {VISKILL.name}, attempt 1\nat work\n"


def test_a_unit_that_cannot_be_started_fails_alone(make: Make, tmp_path: Path) -> None:
    sweep, done = make(VISKILL, OTHER), scripts(tmp_path)

    def command(of: Sweep, unit: Unit) -> Sequence[str]:
        if unit == VISKILL:
            raise OSError(28, "No space left on device")
        return done(of, unit)

    outcomes = Pool(sweep, Notes(), command).run()
    assert {(o.unit, o.status) for o in outcomes} == {(VISKILL, "failed"), (OTHER, "finished")}


def test_a_unit_that_cannot_be_started_again_fails_alone(make: Make, tmp_path: Path) -> None:
    sweep, done = make(VISKILL, OTHER), scripts(tmp_path, "if 'seed0' in str(folder): sys.exit(1)")
    asked: list[Unit] = []

    def command(of: Sweep, unit: Unit) -> Sequence[str]:
        asked.append(unit)
        if asked.count(VISKILL) == 2:
            raise OSError(28, "No space left on device")
        return done(of, unit)

    outcomes = Pool(sweep, Notes(), command).run()
    assert {(o.unit, o.status, o.attempts) for o in outcomes} == {
        (VISKILL, "failed", 1),
        (OTHER, "finished", 1),
    }


def test_no_process_waits_for_what_another_one_learns(make: Make, tmp_path: Path) -> None:
    notes = Notes()
    Pool(make(VISKILL, TSTAR, GCBC, OTHER), notes, scripts(tmp_path)).run()
    begun = [name for name, _ in notes.begun]
    assert begun[:2] == [VISKILL.name, OTHER.name]  # T-STAR and GCBC would have had to wait
    assert set(begun[2:]) == {TSTAR.name, GCBC.name}


def test_while_skills_are_learned_only_a_method_without_skills_may_begin(
    make: Make, tmp_path: Path
) -> None:
    sweep = make(VISKILL, TSTAR, GCBC)
    notes = Notes()
    code = "import time; time.sleep(30)"
    running = Pool(sweep, notes, lambda *_: [sys.executable, "-c", code])
    folder = VISKILL.run_folder(sweep.output)
    try:
        running._begin()
        assert notes.begun == [(VISKILL.name, 1)]
        (folder / "demos.npz").touch()
        running._begin()
        assert notes.begun[1:] == [(GCBC.name, 1)]
        running._running[1].process.kill()
        running._running.pop().process.wait()
        running._begin()
        assert len(notes.begun) == 2
        (folder / "skill-release.npz").touch()
        running._begin()
        assert notes.begun[2:] == [(TSTAR.name, 1)]
    finally:
        running._end()


def test_an_interrupt_ends_the_processes_first(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[int] = []

    class Interrupting(Notes):
        def says(self, unit: Unit, line: str) -> None:
            begun.append(running._running[0].process.pid)
            raise KeyboardInterrupt

    code = "import time; time.sleep(60)"
    running = Pool(make(VISKILL), Interrupting(), lambda *_: [sys.executable, "-c", code])
    with pytest.raises(KeyboardInterrupt):
        running.run()
    with pytest.raises(ProcessLookupError):
        os.kill(begun[0], 0)


def test_a_units_command_is_plain_arguments(make: Make) -> None:
    sweep = make(VISKILL)
    command = unit_command(sweep, VISKILL)
    assert command[1:7] == [
        *("-m", "viskill_deploy.train.unit", "bipegtransfer", "viskill", "0", str(sweep.output)),
    ]
    settings = json.loads(Path(command[command.index("--settings") + 1]).read_text())
    assert settings["environments"] == RunSettings().environments
    others = unit_command(sweep, TSTAR)
    assert others[others.index("--settings") + 1] != command[command.index("--settings") + 1]
    assert command[-4:] == ["--episodes", "100", "--calibration-episodes", "300"]


def test_the_last_full_line_of_a_log_is_shown(tmp_path: Path) -> None:
    log = tmp_path / "log"
    log.write_text("", encoding="utf-8")
    assert last_line(log) == ""
    log.write_text("one\ntwo\nthr", encoding="utf-8")
    assert last_line(log) == "two"
