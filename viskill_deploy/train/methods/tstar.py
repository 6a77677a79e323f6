"""T-STAR: skills are trained on so that each ends where the next one was shown to begin.

Y. Lee et al., "Adversarial Skill Chaining for Long-Horizon Robot Manipulation via Terminal State
Regularization", CoRL 2021, on the DEX skills of the other methods. There is no chaining policy: the
scripted plan gives the subgoals. Each skill in turn starts where the one before it now ends, and is
rewarded at its end for looking like a demonstrated start of the next one. The weights that are kept
are, as for every skill, those of the best test on the skill's own subgoal, the latest of equals.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.vector_loop import VectorLoop
from viskill_deploy.train import store
from viskill_deploy.train.initiation import Likeness
from viskill_deploy.train.optimiser import restore, state_of
from viskill_deploy.train.replay import Batch, Episodes
from viskill_deploy.train.rollout import Act, TaskPolicy, final_goals, plan_of
from viskill_deploy.train.run import (
    Run,
    actor,
    demos_of,
    finish_skill,
    skill_learner,
    skills_of,
    starts_of,
)

WEIGHT = 5.0
"""Reward lost at the end of an episode that looks nothing like a start of the next skill."""

MEETINGS = 60
"""Gradient steps of the discriminator a round."""

HALF_BATCH = 64


class TerminalState:
    """The regularising reward of one skill.

    Args:
        likeness: to the next skill's demonstrated starts.
    """

    def __init__(self, likeness: Likeness) -> None:
        self._likeness = likeness

    def meet(self, episodes: Episodes, rng: np.random.Generator) -> None:
        """Tells demonstrated starts from the states in which these episodes end."""
        for _ in range(MEETINGS if len(episodes) else 0):
            rows = rng.integers(len(episodes), size=HALF_BATCH)
            self._likeness.update(episodes.obs[rows, -2], rng)  # the last one that is rewarded

    def shaped(self, batch: Batch) -> Batch:
        """Less reward where the last state looks like no start of the next skill."""
        lost = WEIGHT * (1.0 - self._likeness.of(batch.next_obs))
        reward = batch.reward - np.where(batch.last, lost, 0.0)
        return dataclasses.replace(batch, reward=reward.astype(np.float32))

    def state(self) -> dict[str, Any]:
        """Everything that learning goes on from."""
        return state_of(self._likeness.network, self._likeness.optimiser)

    def restore(self, tree: dict[str, Any]) -> None:
        """Takes over what `state` gave."""
        restore(tree, self._likeness.network, self._likeness.optimiser)


class Scripted:
    """Skills under the subgoals of the scripted plan, as drawn from a seed.

    Args:
        skills: in order.
        seed: of the plan's handover noise.
    """

    def __init__(self, skills: list[Act], seed: int) -> None:
        self._skills, self._seed = skills, seed
        self._plans: FloatArray | None = None

    def subgoals(self, index: int, obs: FloatArray, loop: VectorLoop) -> FloatArray:
        """The plan's subgoals; the last skill's from the task's own goal."""
        if index == 0 or self._plans is None:
            scenes, layouts = loop.scenes(), int(1e6 * np.abs(obs).sum())
            rng = np.random.default_rng((self._seed, 5, layouts))  # the same for the same episodes
            plans = [plan_of(loop.task, obs[i], scenes[i], rng) for i in range(loop.count)]
            self._plans = np.array(plans)
        if index == len(loop.task.skills) - 1:
            return final_goals(loop, obs)
        return self._plans[:, index].copy()

    def act(self, index: int, obs: FloatArray, goals: FloatArray) -> FloatArray:
        """Actions of a skill."""
        return self._skills[index](obs, goals)


def learn(run: Run) -> TaskPolicy:
    """Skills, then every skill again in order, each regularised towards the next."""
    before, demos = skills_of(run), demos_of(run)
    after: list[dict[str, Any]] = []
    for index, skill in enumerate(run.task.skills):
        stage = f"tstar-{skill.name}"
        if not run.done(stage):
            learner = skill_learner(run, index, starts_of(after[-1]) if after else ())
            if index < len(run.task.skills) - 1:
                starts = demos[index + 1].clean.obs[:, 0]
                learner.shaping = TerminalState(Likeness(run.task, starts, run.seed + index))
            learner.go_on(before[index]["agent"], before[index]["weights"])
            run.learn(stage, learner, run.settings.skill.test_every)
            finish_skill(run, stage, learner)
        after.append(store.load(run.result(stage)))
    return Scripted([actor(run, tree["weights"]) for tree in after], run.seed)
