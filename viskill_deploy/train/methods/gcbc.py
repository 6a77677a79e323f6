"""GCBC: goal-conditioned imitation of whole demonstrations, without skills.

Every later state of a demonstration counts as its goal (Y. Ding et al., NeurIPS 2019).
"""

from __future__ import annotations

import dataclasses

from viskill_deploy.train.flat import learn_flat
from viskill_deploy.train.rollout import TaskPolicy
from viskill_deploy.train.run import Run

NEEDS_SKILLS = False

TIMES = 4
"""As many times `imitation_steps`: about what a skill of the other methods imitates for in all."""


def learn(run: Run) -> TaskPolicy:
    """One policy for the whole task, from demonstrations alone."""
    skill = run.settings.skill
    steps = TIMES * skill.imitation_steps
    skill = dataclasses.replace(
        skill, imitation_steps=steps, polish_steps=0, imitation_hindsight=0.8, rounds=0
    )
    return learn_flat(run, "gcbc", skill)
