"""Learning a task as one long skill: what GCBC and flat DEX share."""

from __future__ import annotations

import dataclasses
from typing import cast

import numpy as np

from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.tasks.base import Task
from viskill_deploy.sim.vector_loop import VectorLoop
from viskill_deploy.train import store
from viskill_deploy.train.hidden import hidden_robots
from viskill_deploy.train.rollout import Act, TaskPolicy, final_goals, fresh, run_task
from viskill_deploy.train.run import Run, actor, demos_of
from viskill_deploy.train.skill_learning import SkillData, SkillLearner, SkillSettings
from viskill_deploy.train.whole_task import WholeTask, whole_demos


class Flat:
    """One policy for all steps, with the task's goal as it is at the start.

    Args:
        act: the policy.
    """

    def __init__(self, act: Act) -> None:
        self._act = act
        self._goals: FloatArray | None = None

    def subgoals(self, index: int, obs: FloatArray, loop: VectorLoop) -> FloatArray:
        """The task's goal."""
        if index == 0 or self._goals is None:
            self._goals = final_goals(loop, obs)
        return self._goals

    def act(self, index: int, obs: FloatArray, goals: FloatArray) -> FloatArray:
        """Actions of the policy."""
        del index
        return self._act(obs, goals)


def uncorrected(skill: SkillSettings, skills: int) -> SkillSettings:
    """The settings without corrections, with as many steps of imitation as all skills together.

    Corrections of a whole task made tests of it worse, see docs/learning.md.
    """
    steps = skill.imitation_steps + max(0, skill.corrections - 1) * skill.correction_steps
    return dataclasses.replace(
        skill,
        imitation_steps=skills * steps,
        polish_steps=skills * skill.polish_steps,
        corrections=0,
    )


def learn_flat(run: Run, stage: str, settings: SkillSettings) -> TaskPolicy:
    """Learns the whole task as one skill; the best in tests of the whole task is kept."""
    if not run.done(stage):
        demos = whole_demos(run.task, demos_of(run))
        loop = VectorLoop(
            cast(Task, WholeTask(run.task)),
            run.settings.environments,
            bystanders=False,
            threads=run.threads,
            robots=hidden_robots(run.task.cell, run.settings.hidden, run.settings.environments),
        )

        def examiner(rng: np.random.Generator, act: Act) -> float:
            fresh(loop, rng, run.settings.distributions)
            return float(run_task(loop, Flat(act)).success.mean())

        learner = SkillLearner(
            loop,
            0,
            SkillData(demos.clean, demos.corrected),
            run.settings.distributions,
            settings,
            run.settings.dex,
            run.seed,
            examiner=examiner,
        )
        run.learn(stage, learner, settings.test_every)
        run.finish(stage, {"weights": learner.best_weights(), "success": learner.best})
    return Flat(actor(run, store.load(run.result(stage))["weights"]))
