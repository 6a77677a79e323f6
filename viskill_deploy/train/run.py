"""A training run in a folder: stages one after the other, each resumable.

A stage leaves one file when it is done and keeps another while it runs. A run that is started again
with the same folder goes on from there, to the same result as without the break.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from pydantic import ConfigDict

from viskill_deploy.core.clock import wall_time
from viskill_deploy.core.errors import DataFileError, TrainingError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.tasks.base import AnyFloatArray, load_task
from viskill_deploy.sim.vector_loop import VectorLoop
from viskill_deploy.train import store
from viskill_deploy.train.demos import TRIES, SkillDemos, record_demos
from viskill_deploy.train.hidden import hidden_robots
from viskill_deploy.train.network import Network, scaling_of
from viskill_deploy.train.provenance import running_commit
from viskill_deploy.train.replay import Episodes
from viskill_deploy.train.results import write_json
from viskill_deploy.train.rollout import Act, Count, Start, run_skill, saved
from viskill_deploy.train.settings import RunSettings, checked, content_of, settings_facts
from viskill_deploy.train.skill_learning import SkillData, SkillLearner

LOG = "log.jsonl"
SETTINGS = "settings.json"

Say = Callable[[str], None]
"""Where progress goes, a line at a time."""

Watch = Callable[[dict[str, Any]], None]
"""Told about every round (what the log says, and the `rounds` of its stage), and at the end of a
stage `{"stage": name, "done": True}`."""


class Learner(Protocol):
    """Something that learns in rounds."""

    @property
    def finished(self) -> bool:
        """Whether there is nothing left to do."""
        ...

    @property
    def rounds(self) -> int:
        """How many it takes at most."""
        ...

    def advance(self) -> dict[str, float]:
        """One round; what there is to say about it."""
        ...

    def state(self) -> dict[str, Any]:
        """Everything that learning goes on from."""
        ...

    def restore(self, tree: dict[str, Any]) -> None:
        """Takes over what `state` gave."""
        ...


@dataclass(frozen=True, slots=True)
class RunFacts:
    """What `settings.json` in the folder of a run says."""

    __pydantic_config__ = ConfigDict(extra="forbid")

    task: str
    seed: int
    settings: RunSettings


def read_facts(path: Path) -> RunFacts:
    """What `write_facts` wrote.

    Raises:
        DataFileError: names file, key and reason.
    """
    return checked(path, RunFacts, content_of(path))


def is_run(path: Path) -> bool:
    """Whether a file is the `settings.json` of a run."""
    try:
        read_facts(path)
    except DataFileError:
        return False
    return True


def write_facts(path: Path, facts: RunFacts) -> None:
    """Writes what a run is; several processes may do so at once."""
    settings = settings_facts(facts.settings)
    write_json(path, {"task": facts.task, "seed": facts.seed, "settings": settings})


@dataclass
class Run:
    """The folder of a run.

    Args:
        folder: made if missing.
        task_name: the task.
        seed: of everything random.
        settings: the rest.
        say: told about progress.
        threads: of physics; gradient steps have one, since their sums depend on how many there are.
        watch: told the same as facts.

    Attributes:
        stages: asked for so far, in order.

    Raises:
        TrainingError: the folder holds another run, or the task does not have such layouts.
        DataFileError: what the folder says of its run is damaged.
    """

    folder: Path
    task_name: str
    seed: int
    settings: RunSettings
    say: Say = print
    threads: int = 1
    watch: Watch | None = None

    def __post_init__(self) -> None:
        self.stages: list[str] = []
        torch.set_num_threads(1)
        self.task = load_task(self.task_name)
        for name in self.settings.distributions:
            if name not in self.task.distributions:
                known = ", ".join(self.task.distributions)
                raise TrainingError(f"{self.task_name} has the distributions {known}, no {name!r}")
        self._loop: VectorLoop | None = None
        self._trial: VectorLoop | None = None
        self.commit = running_commit()
        path = self.folder / SETTINGS
        if not path.is_file() or list(self.folder.iterdir()) == [path]:  # nothing was begun
            write_facts(path, RunFacts(self.task_name, self.seed, self.settings))
        self.insist_own()

    def insist_own(self) -> None:
        """Refuses a folder that is another run's.

        Raises:
            TrainingError: it is.
            DataFileError: what it says of its run is damaged.
        """
        mine = RunFacts(self.task_name, self.seed, self.settings)
        if read_facts(self.folder / SETTINGS) != mine:
            raise TrainingError(
                f"{self.folder} holds a run with another task, seed or settings; "
                "name an empty folder"
            )

    @classmethod
    def open(cls, folder: Path, say: Say = print, threads: int = 1) -> Run:
        """The run that lies in `folder`.

        Raises:
            TrainingError: there is none.
            DataFileError: what it says of itself is damaged.
        """
        path = folder / SETTINGS
        inner = [*folder.glob(f"*/{SETTINGS}"), *folder.glob(f"*/*/{SETTINGS}")]
        runs = sorted(str(one.parent) for one in inner if is_run(one))
        if not path.is_file() or (runs and not is_run(path)):
            there = f"name one of {', '.join(runs)}" if runs else "train first"
            raise TrainingError(f"{folder} holds no training run; {there}")
        facts = read_facts(path)
        return cls(folder, facts.task, facts.seed, facts.settings, say, threads)

    @property
    def loop(self) -> VectorLoop:
        """The environments to learn in, made when first used.

        Free things that are not to be moved are left out: a fifth quicker, and the same unless an
        arm touches them, which `trial` would show.
        """
        if self._loop is None:
            count = self.settings.environments
            robots = hidden_robots(self.task.cell, self.settings.hidden, count)
            self._loop = VectorLoop(
                self.task, count, bystanders=False, threads=self.threads, robots=robots
            )
        return self._loop

    @property
    def trial(self) -> VectorLoop:
        """The environments in which what was learned is measured, with everything in them.

        Their arms are as the cell's files say, whatever robots were learnt on.
        """
        if self._trial is None:
            self._trial = VectorLoop(self.task, self.settings.environments, threads=self.threads)
        return self._trial

    def learn(self, stage: str, learner: Learner, save_every: int = 1) -> None:
        """Lets `learner` finish, going on from `<stage>.state.npz` if there is one."""
        path = self.folder / f"{stage}.state.npz"
        if path.is_file():
            learner.restore(store.load(path))
        rounds, before = 0, wall_time()
        while not learner.finished:
            line = {"stage": stage, **learner.advance()}
            rounds += 1
            now = wall_time()
            line["seconds"], before = round(now - before, 2), now
            self.log(line)  # before the state: a round that is done again is logged again
            if rounds % save_every == 0 or learner.finished:
                store.save(path, learner.state())
            if self.watch:
                self.watch({**line, "rounds": learner.rounds})

    def log(self, line: dict[str, Any]) -> None:
        """Adds a line to the log and says it."""
        path = self.folder / LOG
        torn = path.is_file() and not path.read_bytes().endswith(b"\n")  # killed while writing
        with path.open("a", encoding="utf-8") as log:
            log.write(
                "\n" * torn + json.dumps({key: _plain(value) for key, value in line.items()}) + "\n"
            )
        facts = ", ".join(
            f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}"
            for key, value in line.items()
            if "/" not in key
        )
        self.say(facts)

    def counting(self, stage: str) -> Count:
        """Tells `watch` of episodes as it is told of rounds."""

        def count(done: int, wanted: int) -> None:
            if self.watch:
                self.watch({"stage": stage, "round": done - 1, "rounds": wanted})

        return count

    def done(self, stage: str) -> Path | None:
        """The result file of a stage, if it is there."""
        if stage not in self.stages:
            self.stages.append(stage)
        path = self.result(stage)
        return path if path.is_file() else None

    def result(self, stage: str) -> Path:
        """Where the result of a stage lies."""
        return self.folder / f"{stage}.npz"

    def finish(self, stage: str, tree: store.Tree) -> None:
        """Writes the result of a stage and drops what it kept while it ran."""
        self.log({"stage": stage, "commit": self.commit})
        store.save(self.result(stage), tree)
        (self.folder / f"{stage}.state.npz").unlink(missing_ok=True)
        if self.watch:
            self.watch({"stage": stage, "done": True})


def demos_of(run: Run) -> list[SkillDemos]:
    """The demonstrations of a run, recorded if they are not there yet."""
    if path := run.done("demos"):
        return [_demos_from(tree) for tree in store.load(path)["skills"]]
    started = wall_time()
    settings = run.settings
    demos = record_demos(
        run.loop, settings.demos, settings.distributions, run.seed, run.counting("demos")
    )
    run.log({"stage": "demos", "seconds": round(wall_time() - started, 1)})
    run.finish("demos", {"skills": [_demos_tree(d) for d in demos]})
    return demos


def skills_of(run: Run) -> list[dict[str, Any]]:
    """What is known of every skill, learned one after the other if not there yet.

    Returns:
        Per skill: `weights` of the best actor, its test's `success`, the `agent` at the end,
        smallest and largest observations `seen`, and `ends`, where the skill leaves the task.
    """
    trees: list[dict[str, Any]] = []
    for index, skill in enumerate(run.task.skills):
        stage = f"skill-{skill.name}"
        if not run.done(stage):
            learner = skill_learner(run, index, starts_of(trees[-1]) if trees else ())
            run.learn(stage, learner, run.settings.skill.test_every)
            finish_skill(run, stage, learner)
        trees.append(store.load(run.result(stage)))
    return trees


def starts_of(tree: dict[str, Any]) -> tuple[Start, ...]:
    """The ends of a skill as starts of the next one."""
    return tuple(Start.of(part) for part in tree["ends"])


def skill_learner(run: Run, index: int, learned: tuple[Start, ...]) -> SkillLearner:
    """A learner of one skill at its beginning.

    Args:
        run: gives demonstrations and settings.
        index: of the skill.
        learned: where the learned skill before it ends.
    """
    demos, settings = demos_of(run)[index], run.settings
    data = SkillData(demos.clean, demos.corrected, demos.starts if index else (), learned)
    return SkillLearner(
        run.loop, index, data, settings.distributions, settings.skill, settings.dex, run.seed
    )


def finish_skill(run: Run, stage: str, learner: SkillLearner) -> None:
    """Writes what `skills_of` gives."""
    weights, started = learner.best_weights(), wall_time()
    ends = _ends(run, learner, actor(run, weights))
    run.log({"stage": stage, "ends": len(ends), "seconds": round(wall_time() - started, 2)})
    run.finish(
        stage,
        {
            "weights": weights,
            "success": learner.best,
            "agent": learner.agent.state(),
            "seen": learner.seen(),
            "ends": [start.tree() for start in ends],
        },
    )


def _ends(run: Run, learner: SkillLearner, act: Act) -> list[Start]:
    """Where the learned skill ends, as starts of the next one."""
    if learner.index == len(run.task.skills) - 1:
        return []
    rng = np.random.default_rng((run.seed, learner.index, 2))
    ends: list[Start] = []
    tries, wanted = 0, run.settings.skill.ends
    count = run.counting(f"ends of {run.task.skills[learner.index].name}")
    while len(ends) < wanted:
        goals, plans = learner.begin(rng, spread=True)
        run_skill(run.loop, learner.index, act, goals)
        found = saved(run.loop, plans)
        ends += found
        count(min(wanted, len(ends)), wanted)
        tries = 0 if found else tries + 1
        if tries >= TRIES:
            raise TrainingError(
                f"every episode of {run.task.skills[learner.index].name} broke off, so that the "
                "next skill has no learned start; give it more imitation, or set skill.ends = 0"
            )
    return ends


def actor(run: Run, weights: dict[str, FloatArray]) -> Act:
    """The policy with these weights."""
    network = Network(
        scaling_of(run.task), len(weights["layers.3.bias"]), hidden=len(weights["layers.0.bias"])
    )
    network.load(weights)

    def act(obs: AnyFloatArray, goal: AnyFloatArray) -> FloatArray:
        x = torch.from_numpy(np.concatenate([obs, goal], axis=1).astype(np.float32))
        with torch.no_grad():
            action: FloatArray = torch.tanh(network(x)).numpy().astype(np.float64)
        return action

    return act


def _plain(value: Any) -> Any:
    return float(value) if isinstance(value, np.floating) else value


def _demos_tree(demos: SkillDemos) -> store.Tree:
    return {
        "clean": demos.clean.tree(),
        "corrected": demos.corrected.tree(),
        "starts": [start.tree() for start in demos.starts],
        "clean_aims": demos.clean_aims,
        "corrected_aims": demos.corrected_aims,
    }


def _demos_from(tree: dict[str, Any]) -> SkillDemos:
    return SkillDemos(
        Episodes(**tree["clean"]),
        Episodes(**tree["corrected"]),
        tuple(Start.of(part) for part in tree["starts"]),
        tree["clean_aims"],
        tree["corrected_aims"],
    )
