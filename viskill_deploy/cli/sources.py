"""The options that name files, and the same for all commands that have them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Cell = Annotated[
    str,
    typer.Option(
        "--cell", "--robot", help="Cell: a name in robots/cells, or the path of a TOML file."
    ),
]
Robot = Annotated[
    str,
    typer.Option(
        "--robot",
        "--cell",
        help="Cell of the robot: a name in robots/cells, or the path of a TOML file. That of the "
        "bundle, plan or CAN file by default.",
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
        help="A separate CAN pedal node for consent and emergency stop: can:NAME of robots/inputs, "
        "or can:FILE. Real-time runs only."
    ),
]
