"""The options that name the files of a run; `check`, `dry-run` and `execute` have the same."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Robot = Annotated[
    str,
    typer.Option(
        help="Cell of the robot: a name in robots/cells or the path of a TOML file. "
        "The bundle's own by default."
    ),
]
Calibration = Annotated[Path | None, typer.Option(help="Calibration file of that cell.")]
SceneFile = Annotated[
    Path | None, typer.Option("--scene", help="Scene file: where things are, and how well known.")
]
Truth = Annotated[
    str,
    typer.Option(
        help="Hide a robot in the simulated cell: a seed to draw its errors from, or a file of "
        "`viskill calibrate truth`."
    ),
]
Inputs = Annotated[
    str,
    typer.Option(
        help="Node of its own whose consent and emergency stop count, as can:FILE; such as "
        "can:pedal of robots/inputs. Only against the clock."
    ),
]
