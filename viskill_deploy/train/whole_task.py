"""A task as one long skill, for methods that know no skills."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.types import FloatArray, Scene
from viskill_deploy.sim import vector_task
from viskill_deploy.sim.tasks.base import AnyFloatArray, SkillSpec, Task
from viskill_deploy.sim.vector_loop import VectorLoop
from viskill_deploy.train.demos import SkillDemos
from viskill_deploy.train.replay import Episodes, Float32Array
from viskill_deploy.train.rollout import final_goals, plan_of

WHOLE = "whole"


class WholeScript:
    """The scripted controller of the whole task: of the skill whose turn it is, step by step.

    The turn passes on as soon as a skill stands at its subgoal. It does not wait for the end of the
    skill's time as demonstrations do: a policy that does not know the time would be called back
    from where it rightly is.

    Args:
        task: the task with its skills.
        loop: environments at the start of the task.
        rng: draws the plan's handover noise.
    """

    def __init__(self, task: Task, loop: VectorLoop, rng: np.random.Generator) -> None:
        self._task, self._loop = task, loop
        obs, scenes = loop.observe(), loop.scenes()
        self._plans = np.array([plan_of(task, obs[i], scenes[i], rng) for i in range(loop.count)])
        self._turn = np.zeros(loop.count, dtype=np.intp)

    def __call__(self, obs: AnyFloatArray, goals: AnyFloatArray) -> FloatArray:
        """Actions of the next step, (count, k); the task's goal is not asked for."""
        del goals
        seen, last = np.asarray(obs, np.float64), len(self._task.skills) - 1
        passed_on = self._reached(seen, np.flatnonzero(self._turn < last))
        self._turn[passed_on] += 1
        begun = passed_on[self._turn[passed_on] == last]
        if len(begun):
            self._plans[begun, last] = final_goals(self._loop, seen)[begun]
        return vector_task.scripted_actions(self._task, self._names(), obs, self._subgoals())

    def _names(self) -> list[str]:
        return [self._task.skills[turn].name for turn in self._turn]

    def _subgoals(self) -> FloatArray:
        return self._plans[np.arange(len(self._turn)), self._turn]

    def _reached(self, obs: FloatArray, rows: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
        """Those of the environments `rows` whose skill stands at its subgoal."""
        names, subgoals = self._names(), self._subgoals()
        achieved = vector_task.achieved(self._task, names, obs, self._loop.flags())
        there = [self._task.skill_success(names[i], achieved[i], subgoals[i]) for i in rows]
        mine: npt.NDArray[np.intp] = rows[np.array(there, dtype=bool)]
        return mine


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
