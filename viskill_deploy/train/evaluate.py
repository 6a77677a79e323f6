"""How often a policy does the whole task, in the world that it was trained in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from viskill_deploy.sim.vector_loop import VectorLoop
from viskill_deploy.train.rollout import Count, TaskEpisodes, TaskPolicy, fresh, joined, run_task

EVALUATION = 2**31
"""Added to the seeds of evaluation episodes: neither training nor selection uses them."""


@dataclass(frozen=True, slots=True)
class Score:
    """Result of a number of deterministic episodes.

    Attributes:
        distribution: of the layouts.
        episodes: how many.
        success_rate: part of them that ended with the task done.
        subtasks: mean number of skills that ended at their subgoal.
        rollout_length: mean number of steps in which the running skill was not yet at its subgoal,
            over successful episodes; nan if there is none.
        skills: part of the episodes in which each skill ended at its subgoal.
    """

    distribution: str
    episodes: int
    success_rate: float
    subtasks: float
    rollout_length: float
    skills: dict[str, float]


def evaluate(
    loop: VectorLoop,
    policy: TaskPolicy,
    distribution: str,
    episodes: int,
    seed: int,
    count: Count | None = None,
) -> Score:
    """Runs episodes and counts.

    Args:
        loop: environments.
        policy: who does the task.
        distribution: of the layouts.
        episodes: at least this many; whole lots are run and the surplus is left out.
        seed: of the layouts.
        count: told after every lot.
    """
    rng = np.random.default_rng((EVALUATION, seed))
    lots: list[TaskEpisodes] = []
    while sum(map(len, lots)) < episodes:
        fresh(loop, rng, (distribution,))
        lots.append(run_task(loop, policy))
        if count:
            count(min(episodes, sum(map(len, lots))), episodes)
    return score(loop, joined(lots), distribution, episodes)


def score(loop: VectorLoop, done: TaskEpisodes, distribution: str, episodes: int) -> Score:
    """The figures of the first `episodes` episodes."""
    success, reached = done.success[:episodes], done.reached[:episodes]
    steps = done.waiting[:episodes][success]
    names = [skill.name for skill in loop.task.skills]
    return Score(
        distribution,
        episodes,
        float(success.mean()),
        float(reached.sum(axis=1).mean()),
        float(steps.mean()) if len(steps) else float("nan"),
        dict(zip(names, reached.mean(axis=0).tolist(), strict=True)),
    )
