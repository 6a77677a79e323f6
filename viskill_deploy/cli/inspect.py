"""`viskill inspect`: what a bundle holds, after every check of its integrity."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from rich.text import Text

from viskill_deploy.bundle.format import Bundle, Manifest, load_bundle
from viskill_deploy.runtime.preflight import find_bundle, prepare

SUBGOALS = {
    "scripted": "from the scripted plan",
    "chaining": "chosen by the chaining policy; the last skill's by the task",
}

EXAMPLE = "Example: viskill inspect policies/bipegtransfer-viskill"


def command(
    bundle: Annotated[Path, typer.Argument(help="Folder of a policy bundle.")],
    json_: Annotated[bool, typer.Option("--json", help="Print the manifest as JSON.")] = False,
) -> None:
    """Check a policy bundle and show what it holds."""
    folder = find_bundle(bundle)
    loaded = load_bundle(folder)
    manifest = loaded.manifest
    if json_:
        print(json.dumps(manifest.model_dump(mode="json", by_alias=True)))
        return
    _print(loaded, Console())
    print(f"every file of {folder} is as exported")
    prepare(folder)
    print(f"it fits the cell {manifest.cell} of this installation")


def _value(manifest: Manifest) -> str:
    if manifest.value is None:
        return "none"
    if manifest.value.threshold is None:
        return "the chaining policy's action value at a skill's start, no probability"
    return f"read at every skill's start, low below {manifest.value.threshold:g}"


def _adapter(manifest: Manifest) -> str:
    if manifest.adapter is None:
        return "none, graphs take metres in the task frame"
    origin = ", ".join(f"{x:g}" for x in manifest.adapter.task_origin_m)
    return f"lengths x {manifest.adapter.length_scale:g}, task frame at ({origin}) m of the world"


def _print(bundle: Bundle, console: Console) -> None:
    manifest = bundle.manifest
    facts = Table(title=Text(manifest.name), title_justify="left", show_header=False)
    arms = ", ".join(f"{arm.name} ({arm.robot}, {arm.tool})" for arm in manifest.arms)
    for name, text in (
        ("task", manifest.task),
        ("method", manifest.method),
        ("made by", manifest.created_by),
        ("arms", arms),
        ("adapter", _adapter(manifest)),
        ("policy step", f"{manifest.step_s} s"),
        ("observation", f"{manifest.observation_size} numbers"),
        ("subgoals", f"{manifest.goal_size} numbers, {SUBGOALS[manifest.subgoals]}"),
        ("value", _value(manifest)),
    ):
        facts.add_row(name, Text(text))
    skills = Table("skill", "steps", "subgoal", "value", title="Skills", title_justify="left")
    given = "task" if bundle.chaining else manifest.subgoals
    for skill in manifest.skills:
        source = "chaining" if skill.name in bundle.chaining else given
        told = "told" if skill.name in bundle.values else "–"
        skills.add_row(Text(skill.name), str(skill.budget), source, told)
    graphs = Table("graph", "takes", "gives", title="Graphs", title_justify="left")
    for graph in (*bundle.skills.values(), *bundle.chaining.values(), *bundle.values.values()):
        wants = ", ".join(f"{name} {width}" for name, width in graph.signature.inputs.items())
        graphs.add_row(
            Text(graph.path.name), wants, f"{graph.signature.output} {graph.signature.width}"
        )
    measured = Table(
        "distribution", "mode", "episodes", "success", title="Measured", title_justify="left"
    )
    for row in manifest.measured:
        cells = (row.distribution, row.mode, str(row.episodes), f"{row.success_rate:.2f}")
        measured.add_row(*map(Text, cells))
    for table in (facts, skills, graphs, measured):
        console.print(table)
