"""ViSkill-DM: a subgoal is worth how near its end comes to a demonstrated start (distance measure).

The paper names this ablation without a definition; this is our reading of it.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from viskill_deploy.sim.tasks.base import Task
from viskill_deploy.train.chaining import Chaining, ChainSettings, Transitions
from viskill_deploy.train.initiation import Measure, Nearness
from viskill_deploy.train.methods.viskill import learn_chain
from viskill_deploy.train.rollout import TaskPolicy
from viskill_deploy.train.run import Run, demos_of


class MeasuredChaining(Chaining):
    """Values say how much the end of a skill is like a demonstrated start of the next one.

    Args:
        task: the task.
        settings: numbers of the algorithm.
        seed: of the first weights.
        measures: of every skill's starts, in order.
    """

    def __init__(
        self, task: Task, settings: ChainSettings, seed: int, measures: Sequence[Measure]
    ) -> None:
        super().__init__(task, settings, seed)
        self._measures = tuple(measures)

    def value_target(self, index: int, batch: Transitions) -> torch.Tensor:
        """Likeness at the next skill's start; the outcome for the last skill, (B,)."""
        if index == self.skills - 1:
            return torch.from_numpy(batch.outcome)
        return torch.from_numpy(self._measures[index + 1].of(batch.next_obs))


def learn(run: Run) -> TaskPolicy:
    """Skills, then chaining policies towards demonstrated starts."""
    measures = [Nearness(run.task, demos.clean.obs[:, 0]) for demos in demos_of(run)]
    chaining = MeasuredChaining(run.task, run.settings.chain, run.seed, measures)
    return learn_chain(run, "chain-viskill_dm", chaining)
