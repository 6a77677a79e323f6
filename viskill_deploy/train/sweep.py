"""Runs the units of a sweep in a pool of processes.

Each unit is a process of its own (`viskill_deploy.train.unit`), so that one that dies takes nothing
with it. Units of the same task and seed share demonstrations and skills: while one of them learns
these, the pool prefers units of other runs to letting a second process wait. All state is in the
folders of the runs; a sweep that is started again goes on.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from viskill_deploy.core.clock import MonotonicClock
from viskill_deploy.core.errors import DataFileError, TrainingError, ViskillError
from viskill_deploy.sim.tasks.base import load_task
from viskill_deploy.train.methods import needs_skills
from viskill_deploy.train.results import Unit, read_result, write_json, write_whole
from viskill_deploy.train.settings import settings_facts
from viskill_deploy.train.sweep_file import Sweep
from viskill_deploy.train.unit import RESULT, finished

ATTEMPTS = 2
POLL_S = 0.2
GRACE_S = 10.0
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

Command = Callable[[Sweep, Unit], Sequence[str]]
"""The command line that does a unit."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a unit went.

    Attributes:
        unit: which.
        status: "finished", "skipped" (it was finished before) or "failed".
        attempts: processes that were started for it.
        seconds: from the start of the first attempt to the end of the last.
        log: what the unit printed.
    """

    unit: Unit
    status: str
    attempts: int
    seconds: float
    log: Path


class Watcher(Protocol):
    """Is told how a sweep goes."""

    def started(self, unit: Unit, attempt: int) -> None:
        """A process for the unit was started."""
        ...

    def says(self, unit: Unit, line: str) -> None:
        """The newest line of a running unit."""
        ...

    def over(self, outcome: Outcome) -> None:
        """A unit needs no further process."""
        ...


@dataclass
class _Job:
    """A unit with its process."""

    unit: Unit
    log: Path
    process: subprocess.Popen[bytes]
    began: float
    attempt: int = 1


def unit_command(sweep: Sweep, unit: Unit) -> list[str]:
    """The command line of a unit."""
    settings = unit.run_folder(sweep.output) / unit.method / "unit-settings.json"
    write_json(settings, settings_facts(sweep.settings[unit.task]))
    measuring = sweep.measuring
    return [
        *(sys.executable, "-m", "viskill_deploy.train.unit"),
        *(unit.task, unit.method, str(unit.seed), str(sweep.output)),
        *("--settings", str(settings), "--episodes", str(measuring.episodes)),
        *("--calibration-episodes", str(measuring.calibration_episodes)),
    ]


class Pool:
    """The processes of a sweep.

    Args:
        sweep: what to run.
        watcher: is told how it goes.
        command: of a unit.
    """

    def __init__(self, sweep: Sweep, watcher: Watcher, command: Command = unit_command) -> None:
        self._sweep, self._watcher, self._command = sweep, watcher, command
        self._clock = MonotonicClock()
        self._waiting = list(sweep.units)
        self._running: list[_Job] = []
        self._outcomes: list[Outcome] = []

    def run(self) -> list[Outcome]:
        """Runs all units; on Ctrl-C ends its processes first.

        Raises:
            TrainingError: a folder holds the result of a run with other settings.
            DataFileError: a result in the folder of results is damaged.
        """
        self._skip_finished()
        try:
            while self._waiting or self._running:
                self._begin()
                self._clock.sleep_until(self._clock.now() + POLL_S)
                self._look()
        finally:
            self._end()
        return self._outcomes

    def _skip_finished(self) -> None:
        for unit in self._sweep.units:
            self._check_copy(unit)
            try:
                done = self._finished(unit)
            except DataFileError:
                continue  # damaged: the unit's own process says so, in its log
            if done:
                self._waiting.remove(unit)
                self._over(Outcome(unit, "skipped", 0, 0.0, self._log(unit)))

    def _finished(self, unit: Unit) -> bool:
        sweep = self._sweep
        done = finished(unit, sweep.output, sweep.settings[unit.task], sweep.measuring)
        return done is not None

    def _left_result(self, unit: Unit) -> bool:
        """Whether a process did what it was to do."""
        try:
            return self._finished(unit)
        except ViskillError:
            return False

    def _check_copy(self, unit: Unit) -> None:
        """Refuses to write over a result that comes from elsewhere."""
        path = self._copy(unit)
        if path is None or not path.is_file():
            return
        there = read_result(path)
        settings = settings_facts(self._sweep.settings[unit.task])
        if (there.settings, there.measuring) != (settings, self._sweep.measuring):
            raise TrainingError(
                f"{path} comes from other settings; name another folder for `results`"
            )

    def _copy(self, unit: Unit) -> Path | None:
        """Where the result goes besides."""
        folder = self._sweep.results
        return None if folder is None else folder / f"{unit.name}.json"

    def _begin(self) -> None:
        """Fills the pool with the first units that need not wait for another one."""
        while len(self._running) < self._sweep.processes:
            unit = next((u for u in self._waiting if self._may_begin(u)), None)
            if unit is None:
                return
            self._waiting.remove(unit)
            log = self._log(unit)
            try:
                log.parent.mkdir(parents=True, exist_ok=True)
                process = self._start(unit, log, 1)
            except OSError as error:
                self._watcher.started(unit, 1)
                self._watcher.says(unit, str(error))
                self._over(Outcome(unit, "failed", 0, 0.0, log))
                continue
            self._running.append(_Job(unit, log, process, self._clock.now()))
            self._watcher.started(unit, 1)

    def _may_begin(self, unit: Unit) -> bool:
        """Whether nobody is learning what the unit would wait for."""
        root = self._sweep.output
        folder = unit.run_folder(root)
        beside = [j.unit for j in self._running if j.unit.run_folder(root) == folder]
        if not beside:
            return True
        if not (folder / "demos.npz").is_file():
            return False
        last = load_task(unit.task).skills[-1].name
        if not needs_skills(unit.method) or (folder / f"skill-{last}.npz").is_file():
            return True
        return not any(needs_skills(other.method) for other in beside)

    def _start(self, unit: Unit, log: Path, attempt: int) -> subprocess.Popen[bytes]:
        one = dict.fromkeys(THREAD_VARIABLES, "1")
        with log.open("ab") as file:
            file.write(f"sweep: {unit.name}, attempt {attempt}\n".encode())
            file.flush()
            return subprocess.Popen(
                self._command(self._sweep, unit),
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env={**os.environ, **one},
                start_new_session=True,  # Ctrl-C is for the pool, which ends them in order
            )

    def _look(self) -> None:
        """Sees which processes are over and what the others say."""
        for job in list(self._running):
            code = job.process.poll()
            if code is None:
                self._watcher.says(job.unit, last_line(job.log))
                continue
            done = code == 0 and self._left_result(job.unit)
            if done or job.attempt == ATTEMPTS or not self._again(job):
                self._running.remove(job)
                seconds = round(self._clock.now() - job.began, 1)
                status = "finished" if done else "failed"
                self._over(Outcome(job.unit, status, job.attempt, seconds, job.log))

    def _again(self, job: _Job) -> bool:
        """Starts another process for a unit whose process died, if the machine lets it."""
        try:
            job.process = self._start(job.unit, job.log, job.attempt + 1)
        except OSError:
            return False
        job.attempt += 1
        self._watcher.started(job.unit, job.attempt)
        return True

    def _over(self, outcome: Outcome) -> None:
        copy = self._copy(outcome.unit)
        if outcome.status != "failed" and copy is not None:
            try:
                write_whole(copy, (self._folder(outcome.unit) / RESULT).read_bytes())
            except OSError as error:  # the others go on
                with contextlib.suppress(OSError), outcome.log.open("a", encoding="utf-8") as log:
                    log.write(f"sweep: the result could not be copied: {error}\n")
                outcome = dataclasses.replace(outcome, status="failed")
        self._outcomes.append(outcome)
        self._watcher.over(outcome)

    def _end(self) -> None:
        """Ends what still runs; a unit loses what it did since its last checkpoint."""
        for job in self._running:
            job.process.terminate()
        for job in self._running:
            try:
                job.process.wait(GRACE_S)
            except subprocess.TimeoutExpired:
                job.process.kill()
                job.process.wait()
        self._running.clear()

    def _folder(self, unit: Unit) -> Path:
        return unit.run_folder(self._sweep.output) / unit.method

    def _log(self, unit: Unit) -> Path:
        return self._folder(unit) / "unit.log"


def last_line(log: Path) -> str:
    """The newest full line of a text file, "" if there is none."""
    with log.open("rb") as file:
        file.seek(0, os.SEEK_END)
        file.seek(max(0, file.tell() - 2000))
        lines = file.read().decode("utf-8", "replace").rpartition("\n")[0].splitlines()
    return lines[-1] if lines else ""
