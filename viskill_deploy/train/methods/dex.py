"""DEX on the whole task at once: one policy, the task's own goal, no skills.

It learns as a skill does: imitation, corrections by the script of the skill whose turn it is, DEX;
from the first round on the best in tests of the whole task is kept. Steps of the arms are as many as ViSkill's skills and chain may take together, and steps of
imitation as many as the skills take.
"""

from __future__ import annotations

import dataclasses

from viskill_deploy.train.flat import as_many_steps, learn_flat
from viskill_deploy.train.rollout import TaskPolicy
from viskill_deploy.train.run import Run

NEEDS_SKILLS = False


def learn(run: Run) -> TaskPolicy:
    """One policy for the whole task."""
    skill = as_many_steps(run.settings.skill, len(run.task.skills))
    rounds = skill.rounds + run.settings.amounts.rounds
    never = 2 + skill.corrections + rounds
    return learn_flat(run, "dex", dataclasses.replace(skill, rounds=rounds, patience=never))
