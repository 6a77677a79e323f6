"""One unit of work: learn a method on a task from a seed, measure it, write `result.json`.

A unit needs nothing but a folder and plain arguments, so that anything may run it: `viskill sweep`,
a cluster's scheduler, a shell.

    python -m viskill_deploy.train.unit bipegtransfer viskill 0 runs/paper --settings run.toml

Folders: `<root>/<task>/seed<k>/` is the run in which all methods of that task and seed learn, with
demonstrations and skills that they share; `<method>/` in it holds `training.json` once the method
is learned and `result.json` once it is measured. Units may run side by side: locks see to it that
no two processes learn the same thing at once. A unit that was killed goes on from its last
checkpoint when it is run again, and one that is done does nothing.
"""

from __future__ import annotations

import argparse
import dataclasses
import platform
import resource
import sys
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from viskill_deploy.core.clock import wall_time
from viskill_deploy.core.errors import TrainingError, ViskillError
from viskill_deploy.train import curves, methods
from viskill_deploy.train.calibration import Calibration, calibrate
from viskill_deploy.train.chain_learning import Chained
from viskill_deploy.train.evaluate import evaluate
from viskill_deploy.train.lock import alone
from viskill_deploy.train.paper import MAIN
from viskill_deploy.train.results import (
    SCHEMA,
    Figures,
    Measuring,
    Result,
    Training,
    Unit,
    figures_of,
    read_result,
    write_json,
    write_result,
)
from viskill_deploy.train.rollout import TaskPolicy
from viskill_deploy.train.run import Run, Say, demos_of, skills_of
from viskill_deploy.train.settings import RunSettings, read_settings, settings_facts

TRAINING = "training.json"
RESULT = "result.json"
PACKAGES = ("viskill-deploy", "numpy", "torch", "mujoco")


def do_unit(
    unit: Unit,
    root: Path,
    settings: RunSettings,
    measuring: Measuring,
    threads: int = 1,
    say: Say = print,
) -> Result:
    """Learns and measures, or goes on with it; does nothing for a unit that is done.

    Args:
        unit: what to do.
        root: folder that holds the runs of all units.
        settings: of the run.
        measuring: how it is measured.
        threads: of physics.
        say: told about progress.

    Raises:
        TrainingError: the folder holds another run, or a result that was measured otherwise.
    """
    if result := finished(unit, root, settings, measuring):
        return result
    run = Run(unit.run_folder(root), unit.task, unit.seed, settings, say, threads)
    policy, training = learn(unit.method, run)
    path = run.folder / unit.method / RESULT
    with alone(path.with_name("measuring.lock"), say):
        if result := finished(unit, root, settings, measuring):  # by another process meanwhile
            return result
        result = measured(unit, run, policy, training, measuring)
        write_result(path, result)
    return result


def finished(unit: Unit, root: Path, settings: RunSettings, measuring: Measuring) -> Result | None:
    """The result of a unit that is done, else None.

    Raises:
        TrainingError: it was done with other settings or measured otherwise.
    """
    path = unit.run_folder(root) / unit.method / RESULT
    if not path.is_file():
        return None
    result = read_result(path)
    asked = (unit, settings_facts(settings), measuring)
    if (result.unit, result.settings, result.measuring) != asked:
        raise TrainingError(f"{path} comes from other settings; delete it, or name another folder")
    return result


def learn(method: str, run: Run) -> tuple[TaskPolicy, Training]:
    """What a method learns in a run, and how; goes on where an earlier process stopped.

    Keeps the learning curves of the run up to date.
    """
    tell = run.watch

    def watch(line: dict[str, Any]) -> None:
        if line.get("done"):
            curves.draw(run.folder, [line["stage"]])
        if tell:
            tell(line)

    run.watch = watch
    with alone(run.folder / "demos.lock", run.say):
        run.insist_own()  # another process may have begun another run meanwhile
        demos_of(run)
    if methods.needs_skills(method):
        with alone(run.folder / "skills.lock", run.say):
            skills_of(run)
    path = run.folder / method / TRAINING
    with alone(path.with_name("lock"), run.say):
        policy = methods.learn(method, run)
        if not path.is_file():
            curves.draw(run.folder, run.stages)  # also of stages at whose end a process died
            write_json(path, dataclasses.asdict(_training(run)))
    run.watch = tell
    return policy, TypeAdapter(Training).validate_json(path.read_bytes())


def learned(folder: Path) -> list[str]:
    """The methods that are learned in the folder of a run, sorted."""
    return sorted(path.parent.name for path in folder.glob(f"*/{TRAINING}"))


def measured(
    unit: Unit, run: Run, policy: TaskPolicy, training: Training, measuring: Measuring
) -> Result:
    """Success in every distribution of the task, and calibration of ViSkill's value."""
    seconds: dict[str, float] = {}
    scores: dict[str, Figures] = {}
    started = wall_time()
    for distribution in run.task.distributions:
        score = evaluate(run.trial, policy, distribution, measuring.episodes, unit.seed)
        scores[distribution] = figures_of(score)
        run.say(f"{distribution}: success {score.success_rate:.3f} of {score.episodes} episodes")
    seconds["evaluation"] = round(wall_time() - started, 2)
    calibration: Calibration | None = None
    if unit.method == MAIN and isinstance(policy, Chained) and measuring.calibration_episodes:
        started = wall_time()
        calibration = calibrate(run.trial, policy, measuring.calibration_episodes, unit.seed)
        run.say(f"calibration error {calibration.all.error}")
        seconds["calibration"] = round(wall_time() - started, 2)
    facts = settings_facts(run.settings)
    return Result(SCHEMA, unit, facts, measuring, training, scores, calibration, seconds)


def _training(run: Run) -> Training:
    lines = [line for line in curves.read_log(run.folder) if line["stage"] in run.stages]
    versions = {name: version(name) for name in PACKAGES}
    return Training(
        seconds=curves.stage_seconds(lines),
        curves=curves.rates_of(lines),
        threads=run.threads,
        peak_memory_mib=round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1),
        versions={"python": platform.python_version(), **versions},
        commit=run.commit,
        stages={line["stage"]: line["commit"] for line in lines if "commit" in line},
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """The unit as a command; returns its exit code."""
    usual = Measuring()
    parser = argparse.ArgumentParser(prog="unit", description="Learns and measures one unit.")
    parser.add_argument("task")
    parser.add_argument("method", choices=methods.method_names())
    parser.add_argument("seed", type=int)
    parser.add_argument("root", type=Path, help="folder that holds the runs of all units")
    parser.add_argument("--settings", type=Path, help="TOML or JSON file of the run's settings")
    parser.add_argument("--episodes", type=int, default=usual.episodes)
    parser.add_argument("--calibration-episodes", type=int, default=usual.calibration_episodes)
    parser.add_argument("--threads", type=int, default=1)
    given = parser.parse_args(arguments)

    def say(line: str) -> None:
        print(line, flush=True)

    try:
        measuring = Measuring(given.episodes, given.calibration_episodes)
    except ValueError as error:
        parser.error(str(error))
    try:
        do_unit(
            Unit(given.task, given.method, given.seed),
            given.root,
            read_settings(given.settings),
            measuring,
            given.threads,
            say,
        )
    except ViskillError as error:
        print(f"unit: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
