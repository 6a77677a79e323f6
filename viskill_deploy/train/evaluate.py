"""How often a set of skills does the whole task, in the world that they were trained in."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass

from viskill_deploy.sim.tasks.base import Task
from viskill_deploy.train.episodes import EpisodeRecord, Request, run_episodes

EVALUATION = 2**31
"""First number of the seeds of evaluation episodes: training never uses them."""


@dataclass(frozen=True, slots=True)
class Score:
    """Result of a number of episodes without disturbance.

    Attributes:
        distribution: of the layouts.
        episodes: how many.
        success_rate: part of them that ended with the task done.
        skills: part of them in which each skill reached its own subgoal.
    """

    distribution: str
    episodes: int
    success_rate: float
    skills: dict[str, float]


def evaluate(
    task: Task,
    graphs: Mapping[str, bytes] | None,
    distribution: str,
    episodes: int,
    seed: int,
    pool: ProcessPoolExecutor | None = None,
) -> Score:
    """Runs episodes with every skill driven by its graph, or by the script if there are none."""
    learner = (graphs is not None,) * len(task.skills)
    requests = [
        Request(task.name, (EVALUATION, seed, i), distribution, learner) for i in range(episodes)
    ]
    records = run_episodes(requests, graphs or {}, pool)
    names = [skill.name for skill in task.skills]
    return Score(
        distribution,
        episodes,
        sum(r.success for r in records) / episodes,
        {name: sum(_reached(r, name) for r in records) / episodes for name in names},
    )


def _reached(record: EpisodeRecord, skill: str) -> bool:
    return any(part.skill == skill and part.reached for part in record.skills)
