"""A bundle whose skills are driven by its task's scripted controller instead of trained graphs."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from typing import Any

from viskill_deploy.bundle.format import Bundle, load_bundle
from viskill_deploy.sim.tasks.base import Task


def scripted(folder: Path, task: Task) -> Bundle:
    """The bundle in `folder`, which fits the task, with the script in the place of its graphs."""
    skills: dict[str, Any] = {
        skill.name: functools.partial(task.scripted_action, skill.name) for skill in task.skills
    }
    return replace(load_bundle(folder), skills=skills)
