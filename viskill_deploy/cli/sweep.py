"""`viskill sweep`: many units of work in a pool of processes."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import signal
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer
from rich.console import Console

from viskill_deploy.core.errors import Interrupted, MissingExtraError, TrainingError

EXAMPLE = "Example: viskill sweep sweeps/paper.toml --processes 2"


def command(
    file: Annotated[Path, typer.Argument(help="TOML file of the sweep.")],
    processes: Annotated[
        int | None, typer.Option(min=1, help="Units at the same time, instead of the file's.")
    ] = None,
    json_: Annotated[
        bool, typer.Option("--json", help="Print what came of it as one JSON object, nothing else.")
    ] = False,
) -> None:
    """Run a sweep: task x method x seed, each a process that may die and be resumed.

    Finished units are skipped. A unit that dies is started once more. Exits with 3 if some failed.
    """
    try:
        from viskill_deploy.cli.learning_display import SweepBars  # noqa: PLC0415 - torch
        from viskill_deploy.train.sweep import Pool  # noqa: PLC0415 - is an extra
        from viskill_deploy.train.sweep_file import read_sweep  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise MissingExtraError("train", "viskill sweep") from error
    sweep = read_sweep(file)
    if processes is not None:
        sweep = dataclasses.replace(sweep, processes=processes)
    try:
        with _terminated_like_ctrl_c(), SweepBars(Console(stderr=json_), len(sweep.units)) as bars:
            outcomes = Pool(sweep, bars).run()
    except KeyboardInterrupt as error:
        raise Interrupted("the sweep was ended; started again it goes on") from error
    if json_:
        units = [{**dataclasses.asdict(o), "log": str(o.log)} for o in outcomes]
        print(json.dumps({"units": units}))
    failed = [f"{o.unit.name} (see {o.log})" for o in outcomes if o.status == "failed"]
    if failed:
        raise TrainingError(
            f"{len(failed)} of {len(outcomes)} units failed: {', '.join(failed)}; "
            "mend the cause and start the sweep again, it goes on"
        )


@contextlib.contextmanager
def _terminated_like_ctrl_c() -> Iterator[None]:
    """SIGTERM, too, ends the units' processes first."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
