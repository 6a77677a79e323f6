"""Learning to chain frozen skills: whole tasks, remembered at the borders of their skills."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.vector_loop import VectorLoop
from viskill_deploy.train.chaining import Chaining, Transitions
from viskill_deploy.train.rollout import (
    Act,
    TaskEpisodes,
    final_goals,
    fresh,
    joined,
    run_task,
)
from viskill_deploy.train.skill_learning import VALIDATION, WHOLE_TASKS
from viskill_deploy.train.subgoal_space import POSITIONS


@dataclass(frozen=True, slots=True)
class ChainAmounts:
    """How much of everything.

    Attributes:
        planned_rounds: first rounds, in which the scripted plan gives the subgoals.
        rounds: all rounds; each runs one lot of episodes.
        updates: gradient steps of every skill a round.
        planned_updates: the same after the last planned round.
        test_every: rounds between tests.
        test_lots: lots of episodes in a test.
        spread_share: part of the episodes in which the subgoals of one skill or of some in a row
            are moved at random, so that values are also asked about subgoals and states that the
            policy would not choose.
        spread_m: by up to this on each axis.
        capacity: episodes remembered.
    """

    planned_rounds: int = 4
    rounds: int = 16
    updates: int = 50
    planned_updates: int = 200
    test_every: int = 4
    test_lots: int = 1
    spread_share: float = 0.5
    spread_m: float = 0.04
    capacity: int = 4000


class FrozenSkills:
    """Trained skills under the subgoals of somebody.

    Args:
        skills: in order.
    """

    def __init__(self, skills: Sequence[Act]) -> None:
        self._skills = tuple(skills)

    def act(self, index: int, obs: FloatArray, goals: FloatArray) -> FloatArray:
        """Actions of a skill."""
        return self._skills[index](obs, goals)


class Planned(FrozenSkills):
    """The scripted plan's subgoals.

    Args:
        skills: in order.
        plans: subgoals of every episode, (count, skills, m).
    """

    def __init__(self, skills: Sequence[Act], plans: FloatArray) -> None:
        super().__init__(skills)
        self._plans = plans

    def subgoals(self, index: int, obs: FloatArray, loop: VectorLoop) -> FloatArray:
        """The plan's subgoals; the last skill's from the task's own goal."""
        if index == len(loop.task.skills) - 1:
            return final_goals(loop, obs)
        return self._plans[:, index].copy()


class Chained(FrozenSkills):
    """Subgoals of chaining policies.

    Args:
        skills: in order.
        chaining: the policies.
        rng: samples from them; without it they give their mean.
        spread: moves chosen positions, (count, skills, 6) m.
    """

    def __init__(
        self,
        skills: Sequence[Act],
        chaining: Chaining,
        rng: np.random.Generator | None = None,
        spread: FloatArray | None = None,
    ) -> None:
        super().__init__(skills)
        self.chaining, self._rng, self._spread = chaining, rng, spread

    def moved(self, spread: FloatArray) -> Chained:
        """The same policies' means, their positions moved by `spread`, (count, skills, 6) m."""
        return Chained(self._skills, self.chaining, None, spread)

    def subgoals(self, index: int, obs: FloatArray, loop: VectorLoop) -> FloatArray:
        """What the policies choose, completed by the task."""
        if index == len(loop.task.skills) - 1:
            return final_goals(loop, obs)
        chosen = self.chaining.choose(index, obs, loop.goals(), self._rng)
        if self._spread is not None:
            chosen = chosen + self._spread[:, index]
        name, scenes = loop.task.skills[index].name, loop.scenes()
        return np.array(
            [
                loop.task.complete_subgoal(name, chosen[i], obs[i], scenes[i])
                for i in range(loop.count)
            ]
        )


class Memory:
    """The newest whole-task episodes.

    Args:
        capacity: how many.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._held: TaskEpisodes | None = None

    def __len__(self) -> int:
        return 0 if self._held is None else len(self._held)

    def add(self, episodes: TaskEpisodes) -> None:
        """Takes up episodes; the oldest leave."""
        held = episodes if self._held is None else joined([self._held, episodes])
        surplus = max(0, len(held) - self._capacity)
        self._held = _rows(held, np.arange(surplus, len(held)))

    def sample(
        self, index: int, count: int, rng: np.random.Generator, reached: bool = False
    ) -> Transitions | None:
        """Transitions of one skill, of those that reached their subgoal if asked for."""
        held = self._held
        if held is None:
            return None
        choice = held.begun[:, index] & (held.reached[:, index] if reached else True)
        rows = np.flatnonzero(choice)
        if not len(rows):
            return None
        rows = rng.choice(rows, size=count)
        last = index == held.reached.shape[1] - 1
        follower = index if last else index + 1
        ended = np.ones(count) if last else 1.0 - held.begun[rows, follower]
        return Transitions(
            obs=held.obs[rows, index],
            task_goal=held.task_goal[rows],
            positions=held.subgoal[rows, index, :POSITIONS],
            next_obs=held.obs[rows, index + 1],
            next_positions=held.subgoal[rows, follower, :POSITIONS],
            ended=ended.astype(np.float32),
            outcome=held.success[rows].astype(np.float32),
            next_reached=held.reached[rows, follower].astype(np.float32),
        )

    def state(self) -> dict[str, Any]:
        """What is held, as a tree of arrays."""
        names = TaskEpisodes.__dataclass_fields__
        return {} if self._held is None else {n: getattr(self._held, n) for n in names}

    def restore(self, tree: dict[str, Any]) -> None:
        """Takes over what `state` gave."""
        self._held = TaskEpisodes(**tree) if tree else None


def _rows(episodes: TaskEpisodes, rows: npt.NDArray[np.intp]) -> TaskEpisodes:
    names = TaskEpisodes.__dataclass_fields__
    return TaskEpisodes(*(getattr(episodes, n)[rows] for n in names))


@dataclass
class ChainLearner:
    """Chaining policies in the making.

    Args:
        loop: environments.
        skills: frozen, in order.
        chaining: policies and values.
        distributions: of the layouts.
        amounts: how much of everything.
        seed: of everything random.
    """

    loop: VectorLoop
    skills: Sequence[Act]
    chaining: Chaining
    distributions: tuple[str, ...]
    amounts: ChainAmounts
    seed: int
    round: int = 0
    best: float = -1.0

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng((self.seed, 100))
        self.memory = Memory(self.amounts.capacity)
        self._best: dict[str, Any] = {}

    @property
    def finished(self) -> bool:
        """Whether there is nothing left to do."""
        return self.round >= self.amounts.rounds

    @property
    def rounds(self) -> int:
        """How many it takes at most."""
        return self.amounts.rounds

    def advance(self) -> dict[str, float]:
        """One round; returns what there is to say about it."""
        amounts, line = self.amounts, {"round": float(self.round)}
        episodes = self._explore()
        self.memory.add(episodes)
        line["exploring"] = float(episodes.success.mean())
        planned = self.round < amounts.planned_rounds
        updates = amounts.updates
        if planned:
            last = self.round == amounts.planned_rounds - 1
            updates = amounts.planned_updates if last else 0
        for _ in range(updates):
            for index in reversed(range(len(self.loop.task.skills))):
                line.update(self._update(index))
        self.round += 1
        if not planned and (self.round % amounts.test_every == 0 or self.finished):
            line["success"] = self._test()
        return line

    def _update(self, index: int) -> dict[str, float]:
        batch = self.chaining.settings.batch
        online = self.memory.sample(index, batch, self._rng)
        reached = self.memory.sample(index, batch, self._rng, reached=True)
        if online is None:
            return {}
        line = self.chaining.update(index, online, reached)
        name = self.loop.task.skills[index].name
        return {f"{name}/{key}": value for key, value in line.items()}

    def _explore(self) -> TaskEpisodes:
        plans = fresh(self.loop, self._rng, self.distributions)
        spread = self._spread()
        if self.round < self.amounts.planned_rounds:
            plans[:, :, :POSITIONS] += spread
            return run_task(self.loop, Planned(self.skills, plans))
        return run_task(self.loop, Chained(self.skills, self.chaining, self._rng, spread))

    def _spread(self) -> FloatArray:
        """Moves subgoals of some skills in a row in part of the episodes, (count, skills, 6)."""
        count, skills = self.loop.count, len(self.loop.task.skills)
        ends = np.sort(self._rng.integers(skills - 1, size=(count, 2)), axis=1)
        order = np.arange(skills)
        moved = (order >= ends[:, :1]) & (order <= ends[:, 1:])
        moved &= self._rng.random((count, 1)) < self.amounts.spread_share
        reach = self.amounts.spread_m * self._rng.random((count, 1, 1))
        by = reach * self._rng.uniform(-1.0, 1.0, (count, skills, POSITIONS))
        spread: FloatArray = by * moved[:, :, None] * self.chaining.space.free
        return spread

    def _test(self) -> float:
        rng = np.random.default_rng((self.seed + VALIDATION, *WHOLE_TASKS))
        rates = []
        for _ in range(self.amounts.test_lots):
            fresh(self.loop, rng, self.distributions)
            rates.append(run_task(self.loop, Chained(self.skills, self.chaining)).success.mean())
        rate = float(np.mean(rates))
        if rate >= self.best:
            self.best, self._best = rate, self.chaining.weights()
        return rate

    def best_weights(self) -> dict[str, Any]:
        """Policies and values of the best test, by kind and skill: `{"policies", "values"}`."""
        return self._best

    def state(self) -> dict[str, Any]:
        """Everything that learning goes on from."""
        return {
            "round": self.round,
            "best": self.best,
            "rng": self._rng.bit_generator.state,
            "chaining": self.chaining.state(),
            "memory": self.memory.state(),
            "best_weights": self._best,
        }

    def restore(self, tree: dict[str, Any]) -> None:
        """Takes over what `state` gave."""
        self.round, self.best = tree["round"], tree["best"]
        self._rng.bit_generator.state = tree["rng"]
        self.chaining.restore(tree["chaining"])
        self.memory.restore(tree["memory"])
        self._best = tree["best_weights"]
