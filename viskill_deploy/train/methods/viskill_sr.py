"""ViSkill-SR: a subgoal is worth what the next skill alone makes of it (its subtask's reward).

The paper names this ablation without a definition; this is our reading of it.
"""

from __future__ import annotations

import torch

from viskill_deploy.train.chaining import Chaining, Transitions
from viskill_deploy.train.methods.viskill import learn_chain
from viskill_deploy.train.rollout import TaskPolicy
from viskill_deploy.train.run import Run


class SubtaskChaining(Chaining):
    """Values end at the next skill."""

    def value_target(self, index: int, batch: Transitions) -> torch.Tensor:
        """Whether the next skill reached its subgoal; the outcome for the last skill, (B,)."""
        last = index == self.skills - 1
        return torch.from_numpy(batch.outcome if last else batch.next_reached)


def learn(run: Run) -> TaskPolicy:
    """Skills, then chaining policies for the next skill's success."""
    chaining = SubtaskChaining(run.task, run.settings.chain, run.seed)
    return learn_chain(run, "chain-viskill_sr", chaining)
