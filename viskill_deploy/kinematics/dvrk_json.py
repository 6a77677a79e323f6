"""The dVRK's own JSON arm and instrument files, read into our descriptions.

The dVRK's files know chain, position and effort limits, jaw, tip offset and coupling. What they
lack (velocity, acceleration and jerk limits, the gate's thresholds, the simulated servo) comes from
our file for the same generation, told apart by the insertion's offset. An alpha, theta or offset
written as 1.5708 is read as exactly pi/2 (the dVRK's C++ does so for alpha only, which differs by
1.4 um); a limit stays as written. Masses and inertias, which some files carry, are not used.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from viskill_deploy.core import data
from viskill_deploy.core.description import ArmDescription, join, own_arm
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.core.robot_files import RobotFile, Table, ToolFile, read_toml, validated

WRITTEN_QUARTER_TURN = 1.5708
GENERATIONS = {"Classic": "psm_classic", "Si": "psm_si"}
REFERENCE_TOOL = {"Classic": "large_needle_driver_400006", "Si": "large_needle_driver_420006"}
"""Whose speeds and servo an instrument read from JSON gets: all share one gearbox."""

_COMMENT_OR_STRING = re.compile(r'"(?:\\.|[^"\\])*"|//[^\n]*|/\*.*?\*/', re.DOTALL)


INERTIA = ("mass", *(f"c{x}" for x in "xyz"), *(f"I{x}{y}" for x in "xyz" for y in "xyz"))
AXES = tuple(f"{x}{i}" for x in "xyz" for i in (1, 2, 3))


class _Row(Table):
    """One joint of a dVRK file: rad, m, N m or N, as its type says."""

    @model_validator(mode="before")
    @classmethod
    def _without_inertia(cls, row: Any) -> Any:
        if not isinstance(row, dict):
            return row
        return {key: value for key, value in row.items() if key not in {*INERTIA, *AXES}}

    name: str
    alpha: float
    A: float
    theta: float
    D: float
    type: Literal["revolute", "prismatic"]
    mode: Literal["active"] = "active"
    offset: float
    qmin: float
    qmax: float
    ftmax: Annotated[float, Field(gt=0)]


class _Chain(Table):
    convention: Literal["modified"]
    joints: tuple[_Row, ...]


class _Jaw(Table):
    qmin: float
    qmax: float
    ftmax: Annotated[float, Field(ge=0)]


class _Coupling(Table):
    matrix: tuple[tuple[float, float, float, float], ...] = Field(alias="ActuatorToJointPosition")


class _ArmFile(Table):
    DH: _Chain


class _InstrumentFile(Table):
    DH: _Chain
    jaw: _Jaw
    coupling: _Coupling
    tooltip_offset: tuple[tuple[float, float, float, float], ...]
    tool_engage_position: dict[str, tuple[float, ...]] | None = None


def strip_comments(text: str) -> str:
    """JSON text without its // and /* */ comments; what stands inside strings is kept."""
    return _COMMENT_OR_STRING.sub(lambda m: m[0] if m[0].startswith('"') else " ", text)


def read_json(path: Path) -> dict[str, Any]:
    """The object in a dVRK JSON file, dashes in its top-level keys read as underscores.

    Raises:
        DataFileError: unreadable, no JSON, or no object.
    """
    try:
        content = json.loads(strip_comments(path.read_text(encoding="utf-8")))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise DataFileError(path, "", f"cannot be read as JSON ({error}); correct it") from error
    if not isinstance(content, dict):
        raise DataFileError(path, "", "holds no JSON object; give a dVRK arm or instrument file")
    return {key.replace("-", "_"): value for key, value in content.items()}


def _exact(angle: float) -> float:
    """`angle`, or a quarter turn where it is written as 1.5708."""
    return math.copysign(math.pi / 2, angle) if abs(angle) == WRITTEN_QUARTER_TURN else angle


def robot_from_json(path: Path) -> RobotFile:
    """The robot in a dVRK arm file such as PSM.json.

    Raises:
        DataFileError: refused, or of no generation that we know.
    """
    file = validated(path, _ArmFile, read_json(path))
    known = {name: _packaged_robot(name) for name in GENERATIONS}
    if len(file.DH.joints) != 3:
        raise DataFileError(path, "DH.joints", "has not three joints; give a PSM's arm file")
    near = [
        robot
        for robot in known.values()
        if abs(robot.joint[2].offset - file.DH.joints[2].offset) < 0.02
    ]
    if not near:
        offsets = ", ".join(f"{r.joint[2].offset} ({n})" for n, r in known.items())
        raise DataFileError(
            path, "DH.joints.2.offset", f"matches no generation; expected about {offsets}"
        )
    base = near[0]
    rows = _joints(path, file.DH, [joint.model_dump() for joint in base.joint])
    content = base.model_dump(by_alias=True) | {"name": path.stem.lower(), "joint": rows}
    return validated(path, RobotFile, content)


def tool_from_json(path: Path, generation: str) -> ToolFile:
    """The instrument in a dVRK instrument file, for an arm of `generation`.

    The jaw's closed angle is its lower limit, as the dVRK closes it.

    Raises:
        DataFileError: refused, or its tip offset is more than a rotation.
    """
    file = validated(path, _InstrumentFile, read_json(path))
    base = _packaged_tool(generation)
    offset = np.array(file.tooltip_offset)
    if offset.shape != (4, 4) or np.abs(offset[:3, 3]).max() > 1e-12:
        raise DataFileError(
            path,
            "tooltip_offset",
            "is no 4x4 pure rotation; our control point is the jaw's pivot, so set its last "
            "column to 0 0 0 1",
        )
    if len(file.DH.joints) != 3:
        raise DataFileError(path, "DH.joints", "has not three joints; snake tools are not known")
    content = base.model_dump(by_alias=True) | {
        "name": path.stem.lower(),
        "joint": _joints(path, file.DH, [joint.model_dump() for joint in base.joint]),
        "tip_rotation": offset[:3, :3].tolist(),
        "actuator_to_joint": file.coupling.matrix,
        "jaw": base.jaw.model_dump()
        | {
            "lower_rad": file.jaw.qmin,
            "upper_rad": file.jaw.qmax,
            "grip_angle_rad": file.jaw.qmin,
            "effort_nm": file.jaw.ftmax,
        },
    }
    return validated(path, ToolFile, content)


def _joints(path: Path, chain: _Chain, base: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Our rows with the dVRK file's numbers in them; names stay ours."""
    rows = []
    for i, (row, ours) in enumerate(zip(chain.joints, base, strict=True)):
        if row.type != ours["type"]:
            raise DataFileError(path, f"DH.joints.{i}.type", f"must be {ours['type']}")
        if row.qmin >= row.qmax:
            raise DataFileError(
                path, f"DH.joints.{i}.qmin", f"{row.qmin} must be below qmax {row.qmax}"
            )
        unit, effort = ("m", "n") if row.type == "prismatic" else ("rad", "nm")
        rows.append(
            ours
            | {"alpha_rad": _exact(row.alpha), "a_m": row.A}
            | {"theta_rad": _exact(row.theta), "d_m": row.D}
            | {
                f"offset_{unit}": _exact(row.offset),
                f"lower_{unit}": row.qmin,
                f"upper_{unit}": row.qmax,
            }
            | {"dynamics": (ours["dynamics"] or {}) | {f"effort_{effort}": row.ftmax}}
        )
    return rows


def _packaged_robot(generation: str) -> RobotFile:
    return read_toml(data.find(f"robots/{GENERATIONS[generation]}.toml"), RobotFile)


def _packaged_tool(generation: str) -> ToolFile:
    return read_toml(data.find(f"robots/tools/{REFERENCE_TOOL[generation]}.toml"), ToolFile)


def describe_arm(name: str | Path, tool: str | Path) -> ArmDescription:
    """A robot with an instrument in it, from names of `robots/` or from paths.

    Args:
        name: a name, or the path of a `.toml` of ours or a `.json` arm file of the dVRK.
        tool: likewise for the instrument. A JSON instrument carries no generation: it takes the
            robot's.

    Raises:
        DataFileError: a file is missing or refused; names file, key and reason.
    """
    robot_path = _locate(name, "robots")
    robot = (
        robot_from_json(robot_path)
        if robot_path.suffix == ".json"
        else read_toml(robot_path, RobotFile)
    )
    if robot.instrument is not None:
        return own_arm(robot, str(tool), robot_path)
    tool_path = _locate(tool, "robots/tools")
    instrument = (
        tool_from_json(tool_path, robot.generation)
        if tool_path.suffix == ".json"
        else read_toml(tool_path, ToolFile)
    )
    return join(robot, instrument, (robot_path, tool_path))


def _locate(name: str | Path, folder: str) -> Path:
    """The file that `name` means: a path by its ending, else a name in `folder`."""
    path = Path(name)
    if path.suffix in {".json", ".toml"}:
        if not path.is_file():
            raise DataFileError(path, "", "not found; check the path")
        return path
    return data.find(f"{folder}/{name}.toml")
