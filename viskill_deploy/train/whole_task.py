"""A task as one long skill, for methods that know no skills."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.types import FloatArray, Scene
from viskill_deploy.sim.tasks.base import SkillSpec, Task
from viskill_deploy.train.demos import SkillDemos
from viskill_deploy.train.replay import Episodes, Float32Array

WHOLE = "whole"


class WholeTask:
    """The same task with a single skill that takes all the steps and has the task's own goal.

    Args:
        task: the task with its skills.
    """

    def __init__(self, task: Task) -> None:
        self._task = task
        self._last = task.skills[-1].name
        steps = sum(skill.budget for skill in task.skills)
        self.skills = (SkillSpec(WHOLE, steps, (True,) * len(task.cell.arms)),)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._task, name)

    def subgoals(
        self, observation: FloatArray, scene: Scene, rng: np.random.Generator
    ) -> dict[str, FloatArray]:
        """The task's goal."""
        del rng
        return {WHOLE: self._task.final_subgoal(observation, scene)}

    def achieved(self, skill: str, observation: FloatArray, flags: Sequence[bool]) -> FloatArray:
        """What stands where the task's goal would stand."""
        del skill
        return self._task.achieved(self._last, observation, flags)

    def skill_success(
        self, skill: str, achieved: FloatArray, subgoal: FloatArray
    ) -> npt.NDArray[np.bool_]:
        """The last skill's test."""
        del skill
        return self._task.skill_success(self._last, achieved, subgoal)


def whole_demos(task: Task, demos: Sequence[SkillDemos]) -> SkillDemos:
    """The demonstrations of all skills, put end to end."""
    return SkillDemos(
        _whole(task, [part.clean for part in demos], demos[0].clean_aims),
        _whole(task, [part.corrected for part in demos], demos[0].corrected_aims),
        demos[0].starts,
        demos[0].clean_aims,
        demos[0].corrected_aims,
    )


def _whole(task: Task, parts: Sequence[Episodes], aims: Float32Array) -> Episodes:
    obs = np.concatenate([p.obs[:, :-1] for p in parts] + [parts[-1].obs[:, -1:]], axis=1)
    ends = [p.achieved[:, :-1] for p in parts] + [parts[-1].achieved[:, -1:]]
    flags = np.concatenate(ends, axis=1)[..., 6:]
    achieved = task.achieved(task.skills[-1].name, obs, flags)
    action = np.concatenate([p.action for p in parts], axis=1)
    return Episodes(obs, achieved.astype(np.float32), aims, action)
