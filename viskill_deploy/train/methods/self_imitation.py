"""Self-imitation only: ViSkill's chaining policies imitate reached subgoals and climb nothing.

This is what the official code does in effect: its policy gradient is never reached.
"""

from __future__ import annotations

import dataclasses

from viskill_deploy.train.chaining import Chaining
from viskill_deploy.train.methods.viskill import learn_chain
from viskill_deploy.train.rollout import TaskPolicy
from viskill_deploy.train.run import Run

VALUE_IS_PROBABILITY = True


def learn(run: Run) -> TaskPolicy:
    """Skills, then chaining policies without policy gradient."""
    settings = dataclasses.replace(run.settings.chain, policy_gradient=False, imitation=1.0)
    return learn_chain(run, "chain-self_imitation", Chaining(run.task, settings, run.seed))
