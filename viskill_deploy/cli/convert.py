"""`viskill convert`: one pose of a tool in every frame, so that the usual mistakes show."""

from __future__ import annotations

import json
import math
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from viskill_deploy.cli.names import FrameName, PointName
from viskill_deploy.cli.sources import Cell
from viskill_deploy.core.description import CellDescription, load_cell, rpy_matrix
from viskill_deploy.core.errors import KinematicsError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.kinematics.straight import placed_arm
from viskill_deploy.motion.frames import CONTROL_POINTS, FRAMES, Label, from_task, to_task
from viskill_deploy.motion.resolve import base_poses

EXAMPLE = (
    "Example: viskill convert --cell bipegtransfer --arm PSM1 --frame surrol "
    "--control-point jaw-pivot --rpy -90 0 90 -- 2.5 0.25 3.776"
)

LARGEST = 1e6
"""No position or angle is larger; sums and products of such numbers stay finite."""


def command(
    position: Annotated[
        tuple[float, float, float],
        typer.Argument(help="x y z, after all options and -- where one of them is negative."),
    ],
    cell: Cell,
    arm: Annotated[str, typer.Option(help="Whose tool it is.")],
    frame: Annotated[FrameName, typer.Option(help="What the numbers are seen from.")],
    control_point: Annotated[PointName, typer.Option(help="What the position is about.")],
    rpy: Annotated[
        tuple[float, float, float], typer.Option(help="Fixed-axis x, y, z angles, degrees.")
    ],
    json_: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Show a pose in SurRoL's world, the world, the RCM frame and as CRTK reports it."""
    if not np.abs([*position, *rpy]).max() <= LARGEST:
        raise typer.BadParameter("give a position and angles that are finite numbers")
    description = load_cell(cell)
    names = [entry.name for entry in description.arms]
    if arm not in names:
        raise typer.BadParameter(f"{cell} has the arms {', '.join(names)}")
    index = names.index(arm)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rpy_matrix(*np.radians(rpy).tolist()), position
    tip = to_task(description, index, Label(frame.value, control_point.value), pose)
    rows = _rows(description, index, tip)
    joints, problem = _joints(description, index, tip)
    outside = _outside(description, index, tip)
    if json_:
        told = {"poses": rows, "joints": joints, "problem": problem, "outside_m": outside}
        print(json.dumps(told, allow_nan=False))
        return
    table = Table("frame", "control point", "x", "y", "z", "roll", "pitch", "yaw", title=arm)
    for row in rows:
        numbers = [f"{x:.5f}" for x in row["position"]] + [f"{x:.2f}" for x in row["rpy_deg"]]
        table.add_row(row["frame"], row["control_point"], *numbers)
    console = Console(width=110)
    console.print(table)
    console.print("surrol: its own units (m x 5); all others metres; angles in degrees")
    if joints:
        console.print("joints: " + ", ".join(f"{name} {q:.5f}" for name, q in joints.items()))
    console.print(
        problem or f"{1e3 * outside:.1f} mm outside the workspace"
        if outside > 0 or problem
        else "reachable, inside the workspace"
    )


def _rows(cell: CellDescription, index: int, tip: FloatArray) -> list[dict[str, Any]]:
    """The pose in every frame and about every control point."""
    frames = [f for f in FRAMES if cell.file.surrol or f not in {"world", "surrol"}]
    rows = []
    for frame in reversed(frames):
        for point in CONTROL_POINTS:
            pose = from_task(cell, index, Label(frame, point), tip)
            angles = [math.degrees(a) for a in _rpy(pose[:3, :3])]
            rows.append(
                {
                    "frame": frame,
                    "control_point": point,
                    "position": pose[:3, 3].tolist(),
                    "rpy_deg": angles,
                }
            )
    return rows


def _rpy(R: FloatArray) -> tuple[float, float, float]:
    """Fixed-axis x, y, z angles of a rotation, rad."""
    return (
        math.atan2(R[2, 1], R[2, 2]),
        math.atan2(-R[2, 0], math.hypot(R[0, 0], R[1, 0])),
        math.atan2(R[1, 0], R[0, 0]),
    )


def _joints(cell: CellDescription, index: int, tip: FloatArray) -> tuple[dict[str, float], str]:
    """The joints that bring the tip there, or why there are none."""
    arm = placed_arm(cell.arms[index])
    try:
        q = arm.inverse(base_poses(cell, index, tip[None])[0], cell.arms[index].seed)
    except KinematicsError as error:
        return {}, str(error)
    names = [joint.name for joint in cell.arms[index].arm.joints]
    return dict(zip(names, q.tolist(), strict=True)), ""


def _outside(cell: CellDescription, index: int, tip: FloatArray) -> float:
    """How far the jaw pivot lies outside the arm's workspace, m; not positive inside."""
    entry, p = cell.arms[index].entry, tip[:3, 3]
    low, high = np.array(entry.workspace_lower_m), np.array(entry.workspace_upper_m)
    return float(np.maximum(low - p, p - high).max())
