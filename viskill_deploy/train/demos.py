"""Demonstrations: whole tasks done by the scripted controller."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from viskill_deploy.core.errors import TrainingError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.motion.waypoints import ACTION_SIZE
from viskill_deploy.sim import vector_task
from viskill_deploy.sim.tasks.base import AnyFloatArray, Task
from viskill_deploy.sim.vector_loop import VectorLoop
from viskill_deploy.train.replay import Episodes, Float32Array
from viskill_deploy.train.rollout import (
    Act,
    Count,
    Start,
    final_goals,
    fresh,
    reached,
    run_skill,
    saved,
)

TRIES = 5
"""Lots without one finished episode after which the script is given up."""


@dataclass(frozen=True, slots=True)
class DemoSettings:
    """How many.

    Attributes:
        episodes: demonstrations of every skill, undisturbed.
        corrected: further episodes in which the arms are pushed off their way; what is recorded is
            the script's answer, so they serve imitation alone.
        disturbance: largest standard deviation of the pushes, in parts of the largest action.
    """

    episodes: int = 200
    corrected: int = 200
    disturbance: float = 0.15


@dataclass(frozen=True, slots=True)
class SkillDemos:
    """Demonstrations of one skill.

    Attributes:
        clean: episodes in which every skill reached its subgoal; row e of each skill is of the
            same one.
        corrected: disturbed ones, labelled by the script; rows likewise.
        starts: where the script began the skill, in these and in other episodes.
        clean_aims, corrected_aims: the task's own goal as it stands at the start of each episode,
            as a subgoal of the last skill, (E, m).
    """

    clean: Episodes
    corrected: Episodes
    starts: tuple[Start, ...]
    clean_aims: Float32Array
    corrected_aims: Float32Array


def script(task: Task, index: int) -> Act:
    """The scripted controller of a skill."""
    name = task.skills[index].name

    def act(obs: AnyFloatArray, goals: AnyFloatArray) -> FloatArray:
        return vector_task.scripted_actions(task, [name] * len(obs), obs, goals)

    return act


def record_demos(
    loop: VectorLoop,
    settings: DemoSettings,
    distributions: Sequence[str],
    seed: int,
    count: Count | None = None,
) -> list[SkillDemos]:
    """Demonstrations of every skill, (skills,); `count` is told after every lot."""
    rng, wanted = np.random.default_rng((seed, 0)), settings.episodes + settings.corrected

    def told(before: int, done: int) -> None:
        if count:
            count(before + done, wanted)

    clean, starts, clean_aims = _lots(
        loop, settings.episodes, 0.0, distributions, rng, functools.partial(told, 0)
    )
    corrected, _, corrected_aims = _lots(
        loop,
        settings.corrected,
        settings.disturbance,
        distributions,
        rng,
        functools.partial(told, settings.episodes),
    )
    return [
        SkillDemos(_one(a), _one(b), tuple(s), clean_aims, corrected_aims)
        for a, b, s in zip(clean, corrected, starts, strict=True)
    ]


def _lots(
    loop: VectorLoop,
    wanted: int,
    disturbance: float,
    distributions: Sequence[str],
    rng: np.random.Generator,
    told: Callable[[int], None],
) -> tuple[list[list[Episodes]], list[list[Start]], Float32Array]:
    """Whole tasks until there are `wanted`; row e of every skill is of the same episode."""
    task = loop.task
    episodes: list[list[Episodes]] = [[] for _ in task.skills]
    starts: list[list[Start]] = [[] for _ in task.skills]
    aims: list[FloatArray] = []
    tries = 0
    while sum(map(len, episodes[0])) < wanted:
        plans = fresh(loop, rng, distributions)
        noise, good = push(loop, disturbance, rng), np.ones(loop.count, dtype=bool)
        lot, aim = [], final_goals(loop, loop.observe())
        for index in range(len(task.skills)):
            starts[index] += saved(loop, plans)
            goals = plans[:, index]
            if index == len(task.skills) - 1:
                goals = final_goals(loop, loop.observe())
            act = script(task, index)
            got, alive = run_skill(loop, index, act, goals, rng, noise, labels=act)
            good &= alive & (reached(task, index, got) | (disturbance > 0.0))
            lot.append(got)
        rows = np.flatnonzero(good)
        for part, got in zip(episodes, lot, strict=True):
            part.append(got.only(rows))
        aims.append(aim[rows])
        told(min(wanted, sum(map(len, episodes[0]))))
        tries = 0 if len(rows) else tries + 1
        if tries >= TRIES:
            raise TrainingError(
                f"the scripted controller never finished {task.name}; mend it before training"
            )
    return episodes, starts, np.concatenate(aims).astype(np.float32)


def push(loop: VectorLoop, largest: float, rng: np.random.Generator) -> FloatArray:
    """Standard deviations (count, k), another one for every episode; jaws are left alone."""
    size = ACTION_SIZE * len(loop.task.cell.arms)
    noise = np.tile(largest * rng.random((loop.count, 1)), (1, size))
    noise[:, ACTION_SIZE - 1 :: ACTION_SIZE] = 0.0
    return noise


def _one(parts: Sequence[Episodes]) -> Episodes:
    columns = ("obs", "achieved", "goal", "action")
    return Episodes(*(np.concatenate([getattr(p, c) for p in parts]) for c in columns))
