"""DEX on the whole task at once: one policy, the task's own goal, no skills.

It learns as a skill does, but for corrections: imitation, then DEX; from imitation on the best in
tests of the whole task is kept. Steps of the arms are as many as ViSkill's skills and chain may
take together, and steps of imitation as many as the skills take.
"""

from __future__ import annotations

import dataclasses

from viskill_deploy.train.flat import learn_flat, uncorrected
from viskill_deploy.train.rollout import TaskPolicy
from viskill_deploy.train.run import Run

NEEDS_SKILLS = False
CHAINS = False


def learn(run: Run) -> TaskPolicy:
    """One policy for the whole task."""
    skill = run.settings.skill
    rounds = skill.corrections + skill.rounds + run.settings.amounts.rounds
    flat = uncorrected(skill, len(run.task.skills))
    return learn_flat(run, "dex", dataclasses.replace(flat, rounds=rounds, patience=rounds + 2))
