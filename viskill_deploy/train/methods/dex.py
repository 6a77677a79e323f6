"""DEX on the whole task at once: one policy, the task's own goal, no skills."""

from __future__ import annotations

import dataclasses

from viskill_deploy.train.flat import learn_flat
from viskill_deploy.train.rollout import TaskPolicy
from viskill_deploy.train.run import Run

NEEDS_SKILLS = False


def learn(run: Run) -> TaskPolicy:
    """One policy for the whole task, with about the steps that ViSkill's skills and chain take."""
    skill = run.settings.skill
    rounds = skill.corrections + skill.rounds + run.settings.amounts.rounds
    patient = dataclasses.replace(skill, rounds=rounds, patience=rounds)
    return learn_flat(run, "dex", patient)
