"""Imitation of the scripted controller with corrections: behaviour cloning, then DAgger.

The first round is driven by the script, disturbed. In every later round the learner drives, so that
the script labels the states that the learner gets itself into; each skill also starts from where
the learner's own earlier skills ended (S. Ross et al., AISTATS 2011).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from viskill_deploy.core.clock import wall_time
from viskill_deploy.core.errors import TrainingError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.tasks.base import Task, load_task
from viskill_deploy.train.checkpoint import LOG, Checkpoint, load_checkpoint, save_checkpoint
from viskill_deploy.train.episodes import EpisodeRecord, Request, run_episodes, workers
from viskill_deploy.train.fit import Fit, Labelled, fit
from viskill_deploy.train.graph import skill_graph
from viskill_deploy.train.network import scaling_of

Say = Callable[[str], None]
"""Where progress goes, a line at a time."""


@dataclass(frozen=True, slots=True)
class Settings:
    """How much of everything.

    Attributes:
        demonstrations: episodes of the first round, driven by the script.
        rounds: DAgger rounds after it.
        episodes: in each DAgger round.
        demonstration_updates: gradient steps of each skill after the first round.
        updates: gradient steps of each skill after each DAgger round.
        final_updates: gradient steps of each skill after the last one.
        batch: states in a gradient step.
        disturbance: largest one of the driver's actions, see `Request`; half of the episodes have
            none.
        script_share: part of the skills that the script drives in DAgger rounds.
        distributions: layouts are drawn from these in turn.
        processes: to share the work among.
    """

    demonstrations: int = 60
    rounds: int = 6
    episodes: int = 40
    demonstration_updates: int = 3000
    updates: int = 1500
    final_updates: int = 8000
    batch: int = 256
    disturbance: float = 0.15
    script_share: float = 0.2
    distributions: tuple[str, ...] = ("wide", "wide", "reference")
    processes: int = 2


def train(
    task_name: str,
    seed: int,
    output: Path,
    settings: Settings | None = None,
    say: Say = print,
) -> Checkpoint:
    """Trains every skill of a task; goes on where an earlier call with this output stopped.

    Args:
        task_name: the task.
        seed: of everything random; the same seed gives the same policy.
        output: folder for the checkpoint and the log `train.jsonl`.
        settings: amounts.
        say: told about progress.

    Raises:
        TrainingError: the folder holds another run.
    """
    settings = settings or Settings()
    task = load_task(task_name)
    output.mkdir(parents=True, exist_ok=True)
    state = load_checkpoint(output) or Checkpoint(task_name, seed, asdict(settings), 0, {}, {})
    _check_same(state, task_name, seed, settings, output)
    with workers(settings.processes) as pool:
        for number in range(state.rounds_done, settings.rounds + 1):
            started = wall_time()
            state, line = _round(task, state, number, settings, pool)
            save_checkpoint(output, state)
            line["seconds"] = round(wall_time() - started, 1)
            with (output / LOG).open("a", encoding="utf-8") as log:
                log.write(json.dumps(line) + "\n")
            say(_sentence(line, settings.rounds))
    return state


def graphs_of(task: Task, weights: dict[str, dict[str, FloatArray]]) -> dict[str, bytes]:
    """ONNX graphs of trained skills by name."""
    scaling = scaling_of(task)
    sizes = [sum(n for _, n in lay) for lay in (task.observation_layout, task.goal_layout)]
    return {name: skill_graph(scaling, w, sizes[0], sizes[1]) for name, w in weights.items()}


def _round(
    task: Task, state: Checkpoint, number: int, settings: Settings, pool: ProcessPoolExecutor | None
) -> tuple[Checkpoint, dict[str, object]]:
    requests = list(_requests(task, state.seed, number, settings))
    records = run_episodes(requests, graphs_of(task, state.weights), pool)
    data = _with_records(state.data, records)
    columns = zip(*_jobs(task, state, number, settings, data), strict=True)
    results = list(pool.map(fit, *columns) if pool else map(fit, *columns))
    names = [skill.name for skill in task.skills]
    weights = {name: result[0] for name, result in zip(names, results, strict=True)}
    driven = [r for r in records if all(r.request.learner_drives) and not r.request.disturbance]
    line: dict[str, object] = {
        "round": number,
        "episodes": len(records),
        "learner_success": float(np.mean([r.success for r in driven])) if driven else None,
        "learner_episodes": len(driven),
        "states": {name: len(d.obs) for name, d in data.items()},
        "loss": {name: round(r[1], 5) for name, r in zip(names, results, strict=True)},
    }
    return replace(state, rounds_done=number + 1, weights=weights, data=data), line


def _requests(task: Task, seed: int, number: int, settings: Settings) -> Iterator[Request]:
    rng = np.random.default_rng((seed, number))
    count = settings.episodes if number else settings.demonstrations
    for episode in range(count):
        learner = rng.random(len(task.skills)) >= settings.script_share
        yield Request(
            task.name,
            (seed, number, episode),
            settings.distributions[episode % len(settings.distributions)],
            tuple((learner & (number > 0)).tolist()),
            settings.disturbance * max(0.0, float(rng.uniform(-1.0, 1.0))),
        )


def _jobs(
    task: Task, state: Checkpoint, number: int, settings: Settings, data: dict[str, Labelled]
) -> Iterator[tuple[object, ...]]:
    updates = settings.updates if number else settings.demonstration_updates
    if number == settings.rounds:
        updates = settings.final_updates
    scaling = scaling_of(task)
    for index, skill in enumerate(task.skills):
        seed = state.seed * 1000 + number * 10 + index
        how = Fit(updates, settings.batch, seed)
        yield scaling, data[skill.name], state.weights.get(skill.name), how


def _with_records(data: dict[str, Labelled], records: list[EpisodeRecord]) -> dict[str, Labelled]:
    grown = dict(data)
    for record in records:
        for part in record.skills:
            new = Labelled(part.obs, part.goal, part.action)
            grown[part.skill] = grown[part.skill].joined(new) if part.skill in grown else new
    return grown


def _check_same(state: Checkpoint, task: str, seed: int, settings: Settings, output: Path) -> None:
    """Processes may differ from one call to the next; nothing else may."""
    here = {**asdict(settings), "processes": 0}
    there = {**state.settings, "processes": 0}
    if (state.task, state.seed) != (task, seed) or json.dumps(here) != json.dumps(there):
        raise TrainingError(
            f"{output} holds a run of {state.task} with seed {state.seed} and other settings; "
            "name an empty folder"
        )


def _sentence(line: dict[str, object], rounds: int) -> str:
    success = line["learner_success"]
    seen = "the script drives"
    if success is not None:
        seen = f"the learner, alone and undisturbed, succeeds in {success:.0%}"
        seen += f" of {line['learner_episodes']}"
    return f"round {line['round']}/{rounds}: {seen}; loss {line['loss']}; {line['seconds']} s"
