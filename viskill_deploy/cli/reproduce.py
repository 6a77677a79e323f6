"""`viskill reproduce`: the paper's tables with our numbers, from result files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from viskill_deploy.core.errors import MissingExtraError

EXAMPLE = "Example: viskill reproduce docs/results -o docs/reproduction.md"


def command(
    results: Annotated[Path, typer.Argument(help="Folder of result files.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="The page; figures stand beside it.")
    ] = Path("docs/reproduction.md"),
) -> None:
    """Build the paper's Tables I and II, the figure of values and the times from result files."""
    try:
        from viskill_deploy.train.reproduce import reproduce  # noqa: PLC0415 - torch is an extra
    except ModuleNotFoundError as error:
        raise MissingExtraError("train", "viskill reproduce") from error
    for path in reproduce(results, output):
        print(path)
