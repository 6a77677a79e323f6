"""`viskill train`: learns the skills of a task."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from viskill_deploy.core.errors import MissingExtraError

EXAMPLE = "Example: viskill train bipegtransfer --output runs/imitation --seed 0"


def command(
    task: Annotated[str, typer.Argument(help="Task to learn, such as bipegtransfer.")],
    output: Annotated[
        Path, typer.Option(help="Folder for checkpoint and log; a run in it goes on.")
    ],
    seed: Annotated[int, typer.Option(min=0, help="Seed of everything random.")] = 0,
) -> None:
    """Train every skill of a task by imitation of the scripted controller, with corrections."""
    try:
        from viskill_deploy.train import imitation  # noqa: PLC0415 - torch is an extra
    except ModuleNotFoundError as error:
        raise MissingExtraError("train", "viskill train") from error
    imitation.train(task, seed, output)
    print(f"trained; now: viskill export {output} policies/{task}-imitation")
