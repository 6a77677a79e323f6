"""Runs of skills and of whole tasks, many side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim import vector_task
from viskill_deploy.sim.tasks.base import AnyFloatArray, Task
from viskill_deploy.sim.vector_loop import EpisodeState, VectorLoop
from viskill_deploy.train.replay import Episodes, Float32Array

Count = Callable[[int, int], None]
"""Told how many episodes are done, and of how many."""

Act = Callable[[AnyFloatArray, AnyFloatArray], FloatArray]
"""(observations (N, n), subgoals (N, m)) → actions (N, k)."""


@dataclass(frozen=True, slots=True)
class Start:
    """A moment at which a skill may begin.

    Attributes:
        state: of the simulated episode.
        plan: the scripted plan's subgoals of that episode, (skills, m).
    """

    state: EpisodeState
    plan: FloatArray

    def tree(self) -> dict[str, Any]:
        """The same as plain values."""
        fields = EpisodeState.__dataclass_fields__
        return {"plan": self.plan, **{name: getattr(self.state, name) for name in fields}}

    @classmethod
    def of(cls, tree: dict[str, Any]) -> Start:
        """What `tree` gave."""
        fields = EpisodeState.__dataclass_fields__
        known = {name: tree[name] for name in fields if name in tree}  # older ones have no robot
        return cls(EpisodeState(**known), tree["plan"])


def fresh(loop: VectorLoop, rng: np.random.Generator, distributions: Sequence[str]) -> FloatArray:
    """Begins new episodes everywhere; returns the scripted plans, (count, skills, m)."""
    task = loop.task
    scenes = {
        i: task.sample_layout(rng, distributions[i % len(distributions)]) for i in range(loop.count)
    }
    loop.reset(scenes)
    obs, seen = loop.observe(), loop.scenes()
    return np.array([plan_of(task, obs[i], seen[i], rng) for i in range(loop.count)])


def plan_of(task: Task, obs: FloatArray, scene: object, rng: np.random.Generator) -> FloatArray:
    """The scripted plan's subgoals in the order of the skills, (skills, m)."""
    goals = task.subgoals(obs, scene, rng)  # type: ignore[arg-type]
    return np.array([goals[skill.name] for skill in task.skills])


def saved(loop: VectorLoop, plans: FloatArray) -> list[Start]:
    """The present moment of every episode that is still alive."""
    return [Start(loop.save(i), plans[i]) for i in range(loop.count) if loop.alive[i]]


def resume(loop: VectorLoop, starts: Sequence[Start]) -> FloatArray:
    """Puts every environment at one of `starts` (count of them); returns their plans."""
    loop.restore({i: start.state for i, start in enumerate(starts)})
    return np.array([start.plan for start in starts])


def final_goals(loop: VectorLoop, obs: FloatArray) -> FloatArray:
    """The last skill's subgoal of every episode, from the task's own goal, (count, m)."""
    scenes = loop.scenes()
    return np.array([loop.task.final_subgoal(obs[i], scenes[i]) for i in range(loop.count)])


def run_skill(
    loop: VectorLoop,
    index: int,
    act: Act,
    goals: FloatArray,
    rng: np.random.Generator | None = None,
    noise: FloatArray | float = 0.0,
    labels: Act | None = None,
) -> tuple[Episodes, npt.NDArray[np.bool_]]:
    """One skill for its whole budget in every environment.

    Args:
        loop: at the skill's start.
        index: of the skill.
        act: who drives.
        goals: subgoals, (count, m).
        rng: of the disturbance; none without it.
        noise: its standard deviation, one for all or broadcast to (count, k).
        labels: whose actions are recorded instead of the driver's.

    Returns:
        What happened, and which episodes could be followed to the end.
    """
    task, skill = loop.task, loop.task.skills[index]
    obs = loop.observe()
    names = [skill.name] * loop.count
    seen, actions = [obs], []
    achieved = [vector_task.achieved(task, names, obs, loop.flags())]
    for _ in range(skill.budget):
        action = act(obs, goals)
        recorded = labels(obs, goals) if labels else None
        if rng is not None:
            action = np.clip(action + rng.normal(0.0, noise, action.shape), -1.0, 1.0)
        loop.step(action, [skill] * loop.count)
        obs = loop.observe()
        seen.append(obs)
        achieved.append(vector_task.achieved(task, names, obs, loop.flags()))
        actions.append(action if recorded is None else recorded)
    episodes = Episodes(
        _stacked(seen), _stacked(achieved), goals.astype(np.float32), _stacked(actions)
    )
    return episodes, loop.alive.copy()


def reached(task: Task, index: int, episodes: Episodes) -> npt.NDArray[np.bool_]:
    """Whether each episode ends at its subgoal, (E,)."""
    name = task.skills[index].name
    return task.skill_success(name, episodes.achieved[:, -1], episodes.goal)


class TaskPolicy(Protocol):
    """Who does a whole task."""

    def subgoals(self, index: int, obs: FloatArray, loop: VectorLoop) -> FloatArray:
        """Subgoals of a skill at its start, (count, m)."""
        ...

    def act(self, index: int, obs: FloatArray, goals: FloatArray) -> FloatArray:
        """Actions of a skill, (count, k)."""
        ...


@dataclass(frozen=True, slots=True)
class TaskEpisodes:
    """Whole tasks, seen at the borders of their skills.

    Attributes:
        obs: at the start of every skill and at the end, (E, skills + 1, n).
        task_goal: where the object has to go, (E, 3).
        subgoal: (E, skills, m).
        reached: skill ended at its subgoal, (E, skills).
        begun: the skill was begun (an episode that cannot be followed ends early), (E, skills).
        waiting: steps in which the running skill was not yet at its subgoal, (E,).
        success: the task was done at the last step, (E,).
    """

    obs: Float32Array
    task_goal: Float32Array
    subgoal: Float32Array
    reached: npt.NDArray[np.bool_]
    begun: npt.NDArray[np.bool_]
    waiting: npt.NDArray[np.int64]
    success: npt.NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.success)


def run_task(loop: VectorLoop, policy: TaskPolicy) -> TaskEpisodes:
    """A whole task in every environment, from their present starts.

    Args:
        loop: at the start of episodes.
        policy: who does it.
    """
    task = loop.task
    obs = loop.observe()
    borders, goals, reached_, begun = [obs], [], [], []
    waiting = np.zeros(loop.count, dtype=np.int64)
    for index, skill in enumerate(task.skills):
        begun.append(loop.alive.copy())
        names = [skill.name] * loop.count
        goal = policy.subgoals(index, obs, loop)
        for _ in range(skill.budget):
            loop.step(policy.act(index, obs, goal), [skill] * loop.count)
            obs = loop.observe()
            achieved = vector_task.achieved(task, names, obs, loop.flags())
            here = task.skill_success(skill.name, achieved, goal)
            waiting += ~here
        borders.append(obs)
        goals.append(goal)
        reached_.append(here & loop.alive)
    return TaskEpisodes(
        _stacked(borders),
        loop.goals().astype(np.float32),
        _stacked(goals),
        np.stack(reached_, axis=1),
        np.stack(begun, axis=1),
        waiting,
        loop.success() & loop.alive,
    )


def joined(parts: Sequence[TaskEpisodes]) -> TaskEpisodes:
    """Several lots of episodes as one."""
    names = TaskEpisodes.__dataclass_fields__
    return TaskEpisodes(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))


def _stacked(rows: Sequence[FloatArray]) -> Float32Array:
    return np.stack(rows, axis=1).astype(np.float32)
