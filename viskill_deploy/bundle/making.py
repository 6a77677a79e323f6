"""The manifest of an imported policy: what its task says, and what the import adds."""

from __future__ import annotations

import re
from importlib.metadata import version
from pathlib import Path

from viskill_deploy.bundle.adapter import AdapterEntry
from viskill_deploy.bundle.format import (
    NAME,
    ActionEntry,
    ArmEntry,
    ChainingEntry,
    LayoutEntry,
    Manifest,
    SkillEntry,
    TrainingRange,
    ValueEntry,
    skill_file,
)
from viskill_deploy.core.errors import BundleError
from viskill_deploy.sim.tasks.base import Layout, Task


def new_name(folder: Path) -> str:
    """The name of a bundle that shall be written into a folder: the folder's own.

    Raises:
        BundleError: the folder holds something, or its name is none for a bundle.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise BundleError(folder, "is not an empty folder; name a new one")
    name = folder.resolve().name
    if not re.fullmatch(NAME, name):
        raise BundleError(
            folder, "is no name for a bundle; take letters, digits, spaces and . _ + - alone"
        )
    return name


def imported_manifest(
    task: Task,
    *,
    name: str,
    method: str,
    adapter: AdapterEntry,
    action: ActionEntry,
    training_range: TrainingRange,
    chaining: ChainingEntry | None = None,
    value: ValueEntry | None = None,
) -> Manifest:
    """A manifest for a task of this project, hashes still empty; entries as in `Manifest`."""
    cell = task.cell
    return Manifest(
        schema=1,
        name=name,
        task=task.name,
        cell=cell.name,
        method=method,
        created_by=f"viskill-deploy {version('viskill-deploy')}",
        arms=tuple(
            ArmEntry(name=arm.name, robot=arm.entry.robot, tool=arm.entry.tool) for arm in cell.arms
        ),
        frame="task",
        control_point="jaw_pivot",
        length_unit="m",
        adapter=adapter,
        step_s=cell.file.motion.step_s,
        action=action,
        observation=_layout(task.observation_layout),
        goal=_layout(task.goal_layout),
        skills=tuple(
            SkillEntry(
                name=skill.name,
                file=skill_file(skill.name),
                budget=skill.budget,
                may_open_jaw=skill.may_open_jaw,
            )
            for skill in task.skills
        ),
        subgoals="chaining" if chaining else "scripted",
        chaining=chaining,
        value=value,
        training_range=training_range,
        seeds=(),
        measured=(),
        files={},
    )


def _layout(layout: Layout) -> tuple[LayoutEntry, ...]:
    return tuple(LayoutEntry(name=name, size=size) for name, size in layout)
