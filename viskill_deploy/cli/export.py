"""`viskill export`: a training run as a policy bundle."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from viskill_deploy.core.errors import MissingExtraError

EXAMPLE = "Example: viskill export runs/viskill policies/bipegtransfer-viskill"


def command(
    run: Annotated[Path, typer.Argument(help="Folder that `viskill train` wrote.")],
    output: Annotated[Path, typer.Argument(help="The bundle's folder.")],
    method: Annotated[
        str, typer.Option(help="Whose chaining policy, of those trained in the folder.")
    ] = "viskill",
    episodes: Annotated[
        int, typer.Option(min=0, help="Episodes to measure in each distribution.")
    ] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Seed of those episodes.")] = 0,
) -> None:
    """Export a training run as ONNX graphs with manifest and model card, and measure it."""
    try:
        from viskill_deploy.train.export import export, load_trained  # noqa: PLC0415 - an extra
        from viskill_deploy.train.run import Run  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise MissingExtraError("train", "viskill export") from error
    export(load_trained(Run.open(run), method), output, episodes, seed)
