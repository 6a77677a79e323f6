"""A policy that was exported elsewhere, written as a bundle."""

from __future__ import annotations

from pathlib import Path

from viskill_deploy.bundle.adapter import AdapterEntry
from viskill_deploy.bundle.foreign.description import Description
from viskill_deploy.bundle.foreign.wrapping import wrapped
from viskill_deploy.bundle.format import ActionEntry, TrainingRange, skill_file, write_manifest
from viskill_deploy.bundle.making import imported_manifest, new_name
from viskill_deploy.sim.tasks.base import Task

UNKNOWN_RANGE = 1e6
"""Nothing says what such a policy has seen in training, so S29 cannot speak for it."""

CARD = """# {name}

The ONNX policy {policy} for the task **{task}**, wrapped by the entries of {file}. Every skill of
the task runs the same policy; subgoals are the task's script and matter only where the policy asks
to see them. What the policy has seen in training is not known, so the gate cannot tell when it is
asked about something else (S29).
"""


def write_foreign(policy: Path, description: Description, task: Task, folder: Path) -> Path:
    """Writes a policy as a bundle; every skill of the task runs the same graph.

    Args:
        policy: the ONNX file.
        description: what its numbers mean.
        task: its task in this project.
        folder: of the bundle; new or empty.

    Raises:
        BundleError: the folder is in use, or no usable ONNX file.
        DataFileError: the description does not fit the task or the file; names the line.
    """
    name = new_name(folder)
    description.check(task)
    graph = wrapped(policy, description, task)
    folder.mkdir(parents=True, exist_ok=True)
    for skill in task.skills:
        (folder / skill_file(skill.name)).write_bytes(graph)
    action = description.file.action
    size = sum(count for _, count in task.observation_layout)
    manifest = imported_manifest(
        task,
        name=name,
        method="onnx",
        adapter=AdapterEntry(
            frame="world",
            length_scale=1.0,
            task_origin_m=(0.0, 0.0, 0.0),
            control_point="jaw_pivot",
        ),
        action=ActionEntry(
            reference="setpoint" if action.reference == "setpoint" else "measured",
            displacement_m=action.displacement_m,
            max_displacement_m=action.max_displacement_m,
            rotation=task.action.rotation,
            rotation_rad=action.rotation_rad,
            pitch_rad=action.rotation_rad,
            jaw="binary",
            jaw_open_rad=action.jaw_open_rad,
        ),
        training_range=TrainingRange(lower=(-UNKNOWN_RANGE,) * size, upper=(UNKNOWN_RANGE,) * size),
    )
    text = CARD.format(name=name, policy=policy.name, task=task.name, file=description.path.name)
    (folder / "MODEL_CARD.md").write_text(text, encoding="utf-8")
    write_manifest(folder, manifest)
    return folder
