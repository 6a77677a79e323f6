"""`viskill train`: a method learns a task."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from viskill_deploy.core.errors import Interrupted, MissingExtraError

EXAMPLE = "Example: viskill train bipegtransfer --method viskill --seed 0 --output runs/viskill"


def command(
    task: Annotated[str, typer.Argument(help="Task to learn, such as bipegtransfer.")],
    output: Annotated[
        Path,
        typer.Option(
            help="Folder of the run. A run in it goes on; methods of one task and seed share it."
        ),
    ],
    method: Annotated[
        str, typer.Option(help="A name in viskill_deploy/train/methods.")
    ] = "viskill",
    seed: Annotated[int, typer.Option(min=0, help="Seed of everything random.")] = 0,
    settings: Annotated[
        Path | None, typer.Option(help="TOML file of settings; defaults for what it leaves out.")
    ] = None,
    threads: Annotated[int, typer.Option(min=1, help="Threads of physics.")] = 1,
    environments: Annotated[
        int | None, typer.Option(min=1, help="Episodes side by side, instead of the settings'.")
    ] = None,
) -> None:
    """Train a method on a task; the same seed gives the same run."""
    try:
        from viskill_deploy.cli.learning_display import StageBars  # noqa: PLC0415 - torch
        from viskill_deploy.train import methods, unit  # noqa: PLC0415 - is an extra
        from viskill_deploy.train.run import Run  # noqa: PLC0415
        from viskill_deploy.train.settings import read_settings  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise MissingExtraError("train", "viskill train") from error
    if method not in methods.method_names():
        raise typer.BadParameter(f"choose a method of {', '.join(methods.method_names())}")
    chosen = read_settings(settings)
    if environments is not None:
        chosen = dataclasses.replace(chosen, environments=environments)
    console = Console()
    try:
        with StageBars(console) as bars:
            run = Run(output, task, seed, chosen, bars.say, threads, bars.watch)
            _, training = unit.learn(method, run)
    except KeyboardInterrupt as error:
        raise Interrupted("the run was ended; given again, the command goes on") from error
    seconds = ", ".join(f"{stage} {took:.0f} s" for stage, took in training.seconds.items())
    console.print(f"learned: {seconds}", highlight=False, soft_wrap=True)
    now = f"now: viskill evaluate {output} --method {method}"
    console.print(now, highlight=False, soft_wrap=True)
