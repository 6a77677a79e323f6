"""A task's functions for many environments at once.

A task that is `batched` is called once with arrays that have a first axis of environments; any
other is called once an environment.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import cast

import numpy as np

from viskill_deploy.core.types import FloatArray, Scene
from viskill_deploy.sim.tasks.base import AnyFloatArray, Task
from viskill_deploy.sim.vector_scenes import Scenes


def observe(task: Task, T_task_tip: FloatArray, jaws: FloatArray, scenes: Scenes) -> FloatArray:
    """Observations (N, n) for tips (N, arms, 4, 4), jaw openings (N, arms) and scenes."""
    if _is_batched(task):
        return task.observe(list(T_task_tip.swapaxes(0, 1)), list(jaws.T), cast(Scene, scenes))
    return np.array(
        [
            task.observe(list(T_task_tip[i]), jaws[i].tolist(), scenes.row(i))
            for i in range(len(jaws))
        ]
    )


def scripted_actions(
    task: Task, skills: Sequence[str], observations: AnyFloatArray, subgoals: AnyFloatArray
) -> FloatArray:
    """The scripted controller's actions, (N, k), one skill's name an environment."""

    def act(skill: str, rows: AnyFloatArray, goals: AnyFloatArray) -> FloatArray:
        return task.scripted_action(skill, rows, goals)

    return _by_skill(task, act, skills, observations, subgoals)


def achieved(
    task: Task, skills: Sequence[str], observations: FloatArray, flags: FloatArray
) -> FloatArray:
    """What stands where subgoals would stand, (N, m), one skill's name an environment."""

    def read(skill: str, rows: AnyFloatArray, contacts: AnyFloatArray) -> FloatArray:
        return task.achieved(skill, rows, contacts)

    return _by_skill(task, read, skills, observations, flags)


def _by_skill(
    task: Task,
    function: Callable[[str, AnyFloatArray, AnyFloatArray], FloatArray],
    skills: Sequence[str],
    first: AnyFloatArray,
    second: AnyFloatArray,
) -> FloatArray:
    """Calls a function for all environments with the same skill together, where the task can."""
    if not _is_batched(task):
        return np.array([function(*row) for row in zip(skills, first, second, strict=True)])
    names, results = np.asarray(skills), {}
    for name in dict.fromkeys(skills):
        mine = np.flatnonzero(names == name)
        results[name] = (mine, function(name, first[mine], second[mine]))
    width = next(iter(results.values()))[1].shape[-1]
    out = np.empty((len(first), width))
    for mine, values in results.values():
        out[mine] = values
    return out


def _is_batched(task: Task) -> bool:
    return bool(getattr(task, "batched", False))
