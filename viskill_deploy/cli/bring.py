"""`viskill import`: policies and trajectories that were made elsewhere."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

from viskill_deploy.bundle.format import load_bundle
from viskill_deploy.core.errors import MissingExtraError
from viskill_deploy.sim.tasks.base import load_task

app = typer.Typer(no_args_is_help=True, help="Bring a policy or a trajectory that you have.")

OFFICIAL_EXAMPLE = "Example: viskill import official exp_local -o policies/mine"


class Subgoals(enum.StrEnum):
    """Where the subgoals come from."""

    CHAINING = "chaining"
    SCRIPTED = "scripted"


@app.command("official", epilog=OFFICIAL_EXAMPLE)
def official(
    folder: Annotated[
        Path, typer.Argument(help="Folder above skill_learning/ and viskill/ of the official code.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="The bundle's folder, new.")],
    task: Annotated[
        str | None, typer.Option(help="BiPegTransfer, BiPegBoard or MatchBoard, if several.")
    ] = None,
    skill_seed: Annotated[int | None, typer.Option(help="Seed of the skills, if several.")] = None,
    chaining_seed: Annotated[
        int | None, typer.Option(help="Seed of the chaining policy, if several.")
    ] = None,
    subgoals: Annotated[
        Subgoals, typer.Option(help="From the chaining policy, or from the task's script.")
    ] = Subgoals.CHAINING,
) -> None:
    """Turn checkpoints of the official ViSkill code into a bundle. Nothing in them is executed."""
    try:
        from viskill_deploy.bundle.official.checkpoint import read_official  # noqa: PLC0415
        from viskill_deploy.bundle.official.convert import write_bundle  # noqa: PLC0415 - an extra
        from viskill_deploy.bundle.official.layout import find_checkpoints  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise MissingExtraError("import", "viskill import official") from error
    found = find_checkpoints(folder, task, skill_seed, chaining_seed)
    ours = load_task(found.task)
    policy = read_official(found, ours)
    load_bundle(write_bundle(policy, ours, output, subgoals is Subgoals.SCRIPTED))
    for path in (*found.skills.values(), *filter(None, [found.chaining])):
        print(f"read:   {path}")
    print(f"bundle: {output}")
