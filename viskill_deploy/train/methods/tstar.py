"""T-STAR: skills are trained on so that each ends where the next one was shown to begin.

Y. Lee et al., "Adversarial Skill Chaining for Long-Horizon Robot Manipulation via Terminal State
Regularization", CoRL 2021, on the DEX skills of the other methods. There is no chaining policy: the
scripted plan gives the subgoals. Each skill in turn starts where the one before it now ends, and is
rewarded at its end for looking like a demonstrated start of the next one. It takes as many rounds
as the chain of the other methods, and the weights that are kept are chosen as theirs are: by tests
of the whole task, the latest of equals.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from viskill_deploy.train import store
from viskill_deploy.train.chain_learning import Planned
from viskill_deploy.train.initiation import Likeness
from viskill_deploy.train.methods.planned import Scripted
from viskill_deploy.train.optimiser import restore, state_of
from viskill_deploy.train.replay import Batch, Episodes
from viskill_deploy.train.rollout import Act, Start, TaskPolicy, fresh, run_task
from viskill_deploy.train.run import (
    Run,
    actor,
    demos_of,
    finish_skill,
    skill_learner,
    skills_of,
    starts_of,
)
from viskill_deploy.train.skill_learning import SkillSettings

CHAINS = False

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


def learn(run: Run) -> TaskPolicy:
    """Skills, then every skill again in order, each regularised towards the next."""
    before, demos = skills_of(run), demos_of(run)
    acts = [actor(run, tree["weights"]) for tree in before]
    starts: tuple[Start, ...] = ()
    for index, skill in enumerate(run.task.skills):
        stage = f"tstar-{skill.name}"
        if not run.done(stage):
            learner = skill_learner(run, index, starts)
            learner.settings = _as_long_as_the_chain(run)
            learner.examiner = functools.partial(_whole_tasks, run, tuple(acts), index)
            if index < len(run.task.skills) - 1:
                demonstrated = demos[index + 1].clean.obs[:, 0]
                learner.shaping = TerminalState(Likeness(run.task, demonstrated, run.seed + index))
            learner.go_on(before[index]["agent"], before[index]["weights"])
            run.learn(stage, learner, learner.settings.test_every)
            finish_skill(run, stage, learner)
        after = store.load(run.result(stage))
        acts[index], starts = actor(run, after["weights"]), starts_of(after)
    return Scripted(acts, run.seed)


def _as_long_as_the_chain(run: Run) -> SkillSettings:
    """As many rounds and tests as the chain of the other methods has; none is left out."""
    amounts = run.settings.amounts
    return dataclasses.replace(
        run.settings.skill,
        rounds=amounts.rounds,
        test_every=amounts.test_every,
        test_lots=amounts.test_lots,
        passes=amounts.rounds + 1,
        patience=amounts.rounds + 1,
    )


def _whole_tasks(
    run: Run, acts: Sequence[Act], index: int, rng: np.random.Generator, act: Act
) -> float:
    """Success of whole tasks with `act` in place of one skill."""
    skills = [act if i == index else other for i, other in enumerate(acts)]
    plans = fresh(run.loop, rng, run.settings.distributions)
    return float(run_task(run.loop, Planned(skills, plans)).success.mean())
