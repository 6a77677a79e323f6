"""GCBC: goal-conditioned imitation of whole demonstrations, without skills.

Every later state of a demonstration counts as its goal (Y. Ding et al., NeurIPS 2019). Nothing but
demonstrations is imitated, for as many steps as the skills of the other methods take together.
"""

from __future__ import annotations

import dataclasses

from viskill_deploy.train.flat import learn_flat, uncorrected
from viskill_deploy.train.rollout import TaskPolicy
from viskill_deploy.train.run import Run

NEEDS_SKILLS = False
CHAINS = False


def learn(run: Run) -> TaskPolicy:
    """One policy for the whole task, from demonstrations alone."""
    flat = uncorrected(run.settings.skill, len(run.task.skills))
    return learn_flat(run, "gcbc", dataclasses.replace(flat, imitation_hindsight=0.8, rounds=0))
