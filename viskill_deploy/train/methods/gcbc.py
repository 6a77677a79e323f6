"""GCBC: goal-conditioned imitation of whole demonstrations, without skills.

Every later state of a demonstration counts as its goal (Y. Ding et al., NeurIPS 2019).
"""

from __future__ import annotations

import dataclasses

from viskill_deploy.train.flat import learn_flat
from viskill_deploy.train.rollout import TaskPolicy
from viskill_deploy.train.run import Run

NEEDS_SKILLS = False

STEPS = 12000
"""Gradient steps: about what each skill of the other methods imitates for."""


def learn(run: Run) -> TaskPolicy:
    """One policy for the whole task, from demonstrations alone."""
    skill = dataclasses.replace(
        run.settings.skill, imitation_steps=STEPS, polish_steps=0, imitation_hindsight=0.8, rounds=0
    )
    return learn_flat(run, "gcbc", skill)
