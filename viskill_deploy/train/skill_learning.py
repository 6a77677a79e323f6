"""Learning one skill: imitation of its demonstrations, corrections, then DEX with hindsight.

The learner alternates between runs of the skill in many environments and gradient steps. Runs begin
where the script's earlier skills ended and where the learned ones did, and half of them are given
subgoals that the script's plan would not choose. In rounds of correction the learner drives and the
script says what it would have done (S. Ross et al., AISTATS 2011); after them DEX learns from
experience. Every few rounds the skill is tested without exploration; the best weights are kept.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.tasks.base import Task
from viskill_deploy.sim.vector_loop import VectorLoop
from viskill_deploy.train.demos import push, script
from viskill_deploy.train.dex import Dex, DexSettings
from viskill_deploy.train.network import scaling_of
from viskill_deploy.train.optimiser import state_of
from viskill_deploy.train.replay import Batch, Episodes, Float32Array, Replay
from viskill_deploy.train.rollout import Act, Start, final_goals, fresh, reached, resume, run_skill
from viskill_deploy.train.subgoal_space import POSITIONS, SubgoalSpace

IMITATION_RATE, LOWEST_RATE, POLISHED_RATE = 1e-3, 1e-4, 1e-5
"""Learning rate of imitation: at the start of a round, at its end, at the end of the last one."""

VALIDATION = 2**30
"""Added to the seeds of test rounds: neither training nor the reported evaluation uses them."""

WHOLE_TASKS = (100,)
"""Further seed of tests that are whole tasks: they have the same layouts every time."""


@dataclass(frozen=True, slots=True)
class SkillSettings:
    """Amounts.

    Attributes:
        imitation_steps: gradient steps on demonstrations in the first round.
        imitation_hindsight: part of the imitated states with goals in hindsight.
        corrections: rounds in which the script corrects the learner; the paper has none.
        correction_steps: gradient steps on all that was labelled, in each of them.
        polish_steps: the same in the last of them.
        rounds: of DEX, at most.
        updates: gradient steps in each of them.
        test_every: rounds between tests.
        test_lots: lots of `environments` episodes in a test.
        enough: a test counts as passed from here on.
        passes: tests passed in a row after which learning ends.
        patience: tests without a better result after which it ends, too.
        push: largest standard deviation by which arms are pushed in rounds of correction.
        subgoal_spread_m: subgoals of half of the runs are moved by up to this on each axis.
        learned_starts: part of the runs that begin where the learned earlier skills ended.
        capacity: episodes remembered.
        ends: moments kept at which the learned skill leaves the task, for the next one to start at.
    """

    imitation_steps: int = 3000
    imitation_hindsight: float = 0.0
    corrections: int = 6
    correction_steps: int = 800
    polish_steps: int = 4000
    rounds: int = 9
    updates: int = 500
    test_every: int = 3
    test_lots: int = 1
    enough: float = 0.99
    passes: int = 2
    patience: int = 3
    push: float = 0.15
    subgoal_spread_m: float = 0.010
    learned_starts: float = 0.5
    capacity: int = 2000
    ends: int = 256


@dataclass(frozen=True)
class SkillData:
    """What a skill is learned from.

    Attributes:
        demos: demonstrated episodes that reached their subgoal.
        corrected: disturbed ones with the script's answers, for imitation alone.
        scripted: starts where the script's earlier skills ended; empty for the first skill.
        learned: starts where the learned ones did.
    """

    demos: Episodes
    corrected: Episodes
    scripted: tuple[Start, ...] = ()
    learned: tuple[Start, ...] = ()


class Shaping(Protocol):
    """A further reward."""

    def meet(self, episodes: Episodes, rng: np.random.Generator) -> None:
        """Learns from new experience."""
        ...

    def shaped(self, batch: Batch) -> Batch:
        """The same transitions with other rewards."""
        ...

    def state(self) -> dict[str, Any]:
        """Everything that learning goes on from."""
        ...

    def restore(self, tree: dict[str, Any]) -> None:
        """Takes over what `state` gave."""
        ...


Examiner = Callable[[np.random.Generator, Act], float]
"""(dice of the layouts, policy) → part of the episodes in which it does what counts."""


@dataclass
class SkillLearner:
    """One skill in the making.

    Args:
        loop: environments.
        index: of the skill.
        data: demonstrations and starts.
        distributions: of the layouts.
        settings: amounts.
        dex: numbers of the algorithm.
        seed: of everything random.
        shaping: a further reward, for T-STAR.
        examiner: tests the policy instead of runs of the skill.
    """

    loop: VectorLoop
    index: int
    data: SkillData
    distributions: tuple[str, ...]
    settings: SkillSettings
    dex: DexSettings
    seed: int
    shaping: Shaping | None = None
    examiner: Examiner | None = None
    round: int = 0
    best: float = -1.0
    passed: int = 0
    failed: int = 0

    def __post_init__(self) -> None:
        task: Task = self.loop.task
        name = task.skills[self.index].name
        success = functools.partial(task.skill_success, name)
        self._rng = np.random.default_rng((self.seed, self.index, 1))
        self._free = SubgoalSpace.of(task).free[self.index]
        self.agent = Dex(
            scaling_of(task), self.data.demos.action.shape[2], self.dex, self.seed + self.index
        )
        self.experience = Replay(self.settings.capacity, success)
        self._demos = Replay(len(self.data.demos), success)
        self._demos.add(self.data.demos, self._rng)
        room = self.settings.corrections * self.loop.count
        self._corrected = Replay(len(self.data.corrected) + room, success)
        self._corrected.add(self.data.corrected, self._rng)
        self._best_actor = state_of(self.agent.actor)

    @property
    def finished(self) -> bool:
        """Whether there is nothing left to do."""
        s = self.settings
        dex_rounds = self.round - 1 - s.corrections
        return dex_rounds >= s.rounds or self.passed >= s.passes or self.failed >= s.patience

    @property
    def rounds(self) -> int:
        """How many it takes at most."""
        return 1 + self.settings.corrections + self.settings.rounds

    def advance(self) -> dict[str, float]:
        """One round; returns what there is to say about it. The first round imitates."""
        s = self.settings
        line: dict[str, float] = {"round": self.round}
        dex_rounds = self.round - s.corrections
        if self.round == 0:
            steps = s.imitation_steps if s.corrections else s.imitation_steps + s.polish_steps
            line["imitation"] = self._imitate(steps, last=not s.corrections)
        elif dex_rounds <= 0:
            line["exploring"] = self._correct()
            steps = s.polish_steps if dex_rounds == 0 else s.correction_steps
            line["imitation"] = self._imitate(steps, last=dex_rounds == 0)
        else:
            line["exploring"] = self._explore()
            for _ in range(s.updates if len(self.experience) else 0):
                batches = [
                    memory.sample(self.dex.batch, self.dex.hindsight, self._rng)
                    for memory in (self.experience, self._demos)
                ]
                if self.shaping:
                    batches = [self.shaping.shaped(batch) for batch in batches]
                line.update(self.agent.update(*batches))
        if dex_rounds >= 0 and (dex_rounds % s.test_every == 0 or dex_rounds == s.rounds):
            line["success"] = self._test()
        self.round += 1
        return line

    def go_on(self, agent: dict[str, Any], weights: dict[str, Any]) -> None:
        """Begins with a trained agent and these actor weights instead of imitation."""
        self.agent.restore(agent)
        for actor in (self.agent.actor, self.agent.actor_target):
            actor.load(weights)
        self._test()
        self.round = 1 + self.settings.corrections

    def best_weights(self) -> dict[str, FloatArray]:
        """Numbers of the best actor."""
        weights: dict[str, FloatArray] = self._best_actor["weights"]
        return weights

    def _imitate(self, steps: int, last: bool) -> float:
        """Gradient steps on all that is labelled; returns the mean loss of the last tenth."""
        hindsight, size = self.settings.imitation_hindsight, self.dex.batch
        lowest = POLISHED_RATE if last else LOWEST_RATE
        tail: list[float] = []
        for step in range(steps):
            fall = 0.5 * (1.0 + math.cos(math.pi * step / steps))
            rate = lowest + (IMITATION_RATE - lowest) * fall
            parts = (
                self._demos.sample(size, hindsight, self._rng),
                self._corrected.sample(size, hindsight, self._rng),
            )
            loss = self.agent.imitate(*parts, rate)
            if step >= 0.9 * steps:
                tail.append(loss)
        return float(np.mean(tail)) if tail else math.nan

    def _correct(self) -> float:
        goals, _ = self.begin(self._rng, spread=True)
        noise = push(self.loop, self.settings.push, self._rng)
        labels = script(self.loop.task, self.index)
        episodes, alive = run_skill(
            self.loop, self.index, self.agent.act, goals, self._rng, noise, labels
        )
        self._corrected.add(episodes.only(np.flatnonzero(alive)), self._rng)
        return float((reached(self.loop.task, self.index, episodes) & alive).mean())

    def _explore(self) -> float:
        goals, _ = self.begin(self._rng, spread=True)
        episodes, alive = run_skill(
            self.loop, self.index, self.agent.act, goals, self._rng, self.dex.noise
        )
        followed = episodes.only(np.flatnonzero(alive))
        self.experience.add(followed, self._rng)
        if self.shaping:
            self.shaping.meet(followed, self._rng)
        return float((reached(self.loop.task, self.index, episodes) & alive).mean())

    def _test(self) -> float:
        which = WHOLE_TASKS if self.examiner else (self.index, self.round)
        rng = np.random.default_rng((self.seed + VALIDATION, *which))
        examiner = self.examiner or self._examine
        lots = range(self.settings.test_lots)
        rate = float(np.mean([examiner(rng, self.agent.act) for _ in lots]))
        self.failed = 0 if rate > self.best else self.failed + 1
        if rate >= self.best and self.agent.actor.is_finite:
            self.best, self._best_actor = rate, state_of(self.agent.actor)
        self.passed = self.passed + 1 if rate >= self.settings.enough else 0
        return rate

    def _examine(self, rng: np.random.Generator, act: Act) -> float:
        goals, _ = self.begin(rng, spread=False)
        episodes, alive = run_skill(self.loop, self.index, act, goals)
        return float((reached(self.loop.task, self.index, episodes) & alive).mean())

    def begin(self, rng: np.random.Generator, spread: bool) -> tuple[FloatArray, FloatArray]:
        """Puts the environments at starts of the skill.

        Args:
            rng: picks them.
            spread: moves the subgoals of half of them.

        Returns:
            The subgoals (count, m), and the scripted plans (count, skills, m).
        """
        plans = self._placed(rng)
        if self.index == len(self.loop.task.skills) - 1:
            return final_goals(self.loop, self.loop.observe()), plans
        goals = plans[:, self.index].copy()
        if spread:
            reach = self.settings.subgoal_spread_m
            moved = rng.random(self.loop.count) < 0.5
            by = rng.uniform(-reach, reach, (int(moved.sum()), POSITIONS))
            goals[moved, :POSITIONS] += by * self._free
        return goals, plans

    def _placed(self, rng: np.random.Generator) -> FloatArray:
        if not self.data.scripted:
            return fresh(self.loop, rng, self.distributions)
        starts = []
        for _ in range(self.loop.count):
            learned = self.data.learned and rng.random() < self.settings.learned_starts
            pool = self.data.learned if learned else self.data.scripted
            starts.append(pool[int(rng.integers(len(pool)))])
        return resume(self.loop, starts)

    def seen(self) -> Float32Array:
        """Smallest and largest observations of demonstrations and experience, (2, n)."""
        parts = [self.data.demos.obs, self._corrected.state()["obs"]]
        if len(self.experience):
            parts.append(self.experience.state()["obs"])
        rows = [part.reshape(-1, part.shape[-1]) for part in parts]
        low = np.min([part.min(axis=0) for part in rows], axis=0)
        high = np.max([part.max(axis=0) for part in rows], axis=0)
        return np.stack([low, high])

    def state(self) -> dict[str, Any]:
        """Everything that learning goes on from."""
        return {
            "round": self.round,
            "best": self.best,
            "passed": self.passed,
            "failed": self.failed,
            "rng": self._rng.bit_generator.state,
            "agent": self.agent.state(),
            "experience": self.experience.state(),
            "corrected": self._corrected.state(),
            "best_actor": self._best_actor,
            "shaping": self.shaping.state() if self.shaping else None,
        }

    def restore(self, tree: dict[str, Any]) -> None:
        """Takes over what `state` gave."""
        self.round, self.best = tree["round"], tree["best"]
        self.passed, self.failed = tree["passed"], tree["failed"]
        self._rng.bit_generator.state = tree["rng"]
        self.agent.restore(tree["agent"])
        self.experience.restore(tree["experience"])
        self._corrected.restore(tree["corrected"])
        self._best_actor = tree["best_actor"]
        if self.shaping:
            self.shaping.restore(tree["shaping"])
