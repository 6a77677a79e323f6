"""An official policy written as a bundle: graphs as trained, adapter and provenance beside them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from viskill_deploy.bundle.adapter import AdapterEntry
from viskill_deploy.bundle.format import (
    ActionEntry,
    ChainingEntry,
    Manifest,
    TrainingRange,
    ValueEntry,
    chain_file,
    skill_file,
    value_file,
    write_manifest,
)
from viskill_deploy.bundle.making import imported_manifest, new_name
from viskill_deploy.bundle.official.checkpoint import Official
from viskill_deploy.bundle.official.graphs import chain_graph, skill_graph, value_graph
from viskill_deploy.core.errors import BundleError, DataFileError
from viskill_deploy.sim.tasks.base import Layout, Task

DISPLACEMENT_M = 0.010
ROTATION_RAD, PITCH_RAD, JAW_OPEN_RAD = (math.radians(a) for a in (30.0, 15.0, 40.0))

CARD = "MODEL_CARD.md"
CARD_TEXT = """# {name}

Official ViSkill checkpoints for the task **{task}**, imported by {created_by}.

{sources}

Graphs compute what the official code computes, in its scaled world units, normalizers inside; the
manifest's `adapter` says how the runtime's metres in the task frame become those (lengths x
{scale:g}, task frame at {origin} m of the world). Positions are about the jaw pivot, the origin of
the wrist-yaw frame. Displacements are added to what is measured, as in training. The jaws open to
40 degrees; closed is the tool's own grip angle.

## Limits
- The policy was trained in another simulator. Contacts, tracking, layouts and the height of the
  goal differ here; a success figure of this project's simulator says how well it carries over, and
  nothing about how well it was trained.
- An action of the official code may move 17 mm in a step of 0.2 s. The line keeps its tip speed,
  so such a step takes longer here.
- `training_range` is what the normalizers let through: five standard deviations about the mean.
"""


def write_bundle(official: Official, task: Task, folder: Path, scripted: bool = False) -> Path:
    """Writes an official policy as a bundle.

    Args:
        official: the policy.
        task: its task in this project.
        folder: of the bundle; new or empty.
        scripted: take the subgoals from the task's scripted plan, not from the chaining policy.

    Raises:
        BundleError: the folder is in use, or there is no chaining policy to take subgoals from.
    """
    bundle_name = new_name(folder)
    if not official.chaining and not scripted:
        raise BundleError(
            next(iter(official.skills.values())).path,
            "has no chaining checkpoint beside it; put the viskill/ folder there, or import the "
            "skills alone with --subgoals scripted",
        )
    graphs = {skill_file(name): skill_graph(skill) for name, skill in official.skills.items()}
    goal = sum(size for _, size in task.goal_layout)
    for name, chain in {} if scripted else official.chaining.items():
        graphs[chain_file(name)] = chain_graph(chain)
        graphs[value_file(name)] = value_graph(chain, goal)
    folder.mkdir(parents=True, exist_ok=True)
    for file, graph in graphs.items():
        (folder / file).write_bytes(graph)
    manifest = _manifest(official, task, bundle_name, scripted)
    (folder / CARD).write_text(_card(official, manifest, _adapter(task)), encoding="utf-8")
    write_manifest(folder, manifest)
    return folder


def _manifest(official: Official, task: Task, name: str, scripted: bool) -> Manifest:
    adapter = _adapter(task)
    chained = [] if scripted else list(official.chaining)
    chaining = ChainingEntry(graphs={s: chain_file(s) for s in chained})
    value = ValueEntry(graphs={s: value_file(s) for s in chained}, meaning="return")
    return imported_manifest(
        task,
        name=name,
        method="official",
        adapter=adapter,
        action=ActionEntry(
            reference="measured",
            displacement_m=DISPLACEMENT_M,
            max_displacement_m=math.sqrt(3.0) * DISPLACEMENT_M,
            rotation=task.action.rotation,
            rotation_rad=ROTATION_RAD,
            pitch_rad=PITCH_RAD,
            jaw="binary",
            jaw_open_rad=JAW_OPEN_RAD,
        ),
        training_range=_range(official, adapter, task.observation_layout),
        chaining=chaining if chained else None,
        value=value if chained else None,
    )


def _adapter(task: Task) -> AdapterEntry:
    world = task.cell.file.surrol
    if world is None:
        raise DataFileError(
            task.cell.files[0], "surrol", "missing; it says where the task is in that world"
        )
    return AdapterEntry(
        frame="world",
        length_scale=world.length_scale,
        task_origin_m=world.task_origin_m,
        control_point="jaw_pivot",
    )


def _range(official: Official, adapter: AdapterEntry, layout: Layout) -> TrainingRange:
    """What the normalizers of the skills tell apart, in metres in the task frame."""
    change = adapter.affine(layout)
    scales = [skill.observation for skill in official.skills.values()]
    low = np.min([change.back(s.mean - s.clip * s.std) for s in scales], axis=0)
    high = np.max([change.back(s.mean + s.clip * s.std) for s in scales], axis=0)
    return TrainingRange(lower=tuple(map(float, low)), upper=tuple(map(float, high)))


def _card(official: Official, manifest: Manifest, adapter: AdapterEntry) -> str:
    sources = [f"- `{name}`: {skill.path.name}" for name, skill in official.skills.items()]
    sources.append(f"- subgoals: {manifest.subgoals}")
    return CARD_TEXT.format(
        name=manifest.name,
        task=manifest.task,
        created_by=manifest.created_by,
        sources="\n".join(sources),
        scale=adapter.length_scale,
        origin=adapter.task_origin_m,
    )
