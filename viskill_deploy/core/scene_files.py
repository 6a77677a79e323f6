"""The schema of a scene file: where things are, as somebody has measured it, and how well.

Positions are metres in the task frame of the cell; a pose's covariance is that of its position, m²,
and of a small rotation about the task frame's axes, rad². It is given as a whole, six by six, or as
standard deviations of the six. A `[board]` says where the board was found at the same time: it has
to be where the calibration has it, because pegs and goals are reckoned from there.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from viskill_deploy.core.description import rpy_matrix
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.core.robot_files import NonNegative, Table, Vector3, read_toml
from viskill_deploy.core.types import FloatArray, ObjectPose, Scene

FARTHEST_M = 1.0
"""No board is larger; millimetres are told from metres by it."""

BOARD_M, BOARD_LEVER_M = 0.0015, 0.05
"""How far a point of the board that is `BOARD_LEVER_M` from its middle may be from its place: what
S27 lets a calibration leave."""

SYMMETRIC = 1e-9
"""Part of its largest entry by which a covariance may miss symmetry, and an eigenvalue zero."""

Six = tuple[float, float, float, float, float, float]
Sigmas = tuple[NonNegative, NonNegative, NonNegative]


class PoseEntry(Table):
    """Where something is, and how well that is known.

    Attributes:
        rotation_rpy_rad: angles about the fixed axes x, y and z of the task frame, in this order.
        covariance: of position and rotation, row by row.
        sigma_position_m, sigma_rotation_rad: its diagonal's roots, where the rest is zero.
    """

    position_m: Vector3
    rotation_rpy_rad: Vector3 = (0.0, 0.0, 0.0)
    covariance: tuple[Six, Six, Six, Six, Six, Six] | None = None
    sigma_position_m: Sigmas | None = None
    sigma_rotation_rad: Sigmas | None = None

    @field_validator("position_m")
    @classmethod
    def _is_near(cls, position: Vector3) -> Vector3:
        return _near(position)

    @model_validator(mode="after")
    def _says_how_well(self) -> PoseEntry:
        sigmas = [self.sigma_position_m, self.sigma_rotation_rad]
        if [s is None for s in sigmas] != [self.covariance is not None] * 2:
            raise ValueError("give covariance, or both sigma_position_m and sigma_rotation_rad")
        C = self.spread
        size = float(abs(C).max())
        if abs(C - C.T).max() > SYMMETRIC * size:
            raise ValueError("covariance is not symmetric")
        if np.linalg.eigvalsh(C).min() < -SYMMETRIC * size:
            raise ValueError("covariance has a negative eigenvalue")
        return self

    @property
    def spread(self) -> FloatArray:
        """The covariance, (6, 6)."""
        if self.covariance is not None:
            return np.array(self.covariance)
        sigmas = (*(self.sigma_position_m or ()), *(self.sigma_rotation_rad or ()))
        return np.diag(np.square(sigmas))

    @property
    def matrix(self) -> FloatArray:
        """The pose, (4, 4)."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rpy_matrix(*self.rotation_rpy_rad), self.position_m
        return T


class ObjectEntry(PoseEntry):
    """One thing on the board; `name` as the task calls it, such as "block0"."""

    name: str

    @property
    def pose(self) -> ObjectPose:
        """Where it is."""
        return ObjectPose(self.name, self.matrix)


class BoardEntry(PoseEntry):
    """The board itself, as it was found; it has to be where the task frame is.

    Attributes:
        held_out_m: median distance of its points from a fit that has not seen them.
    """

    held_out_m: NonNegative | None = None

    @model_validator(mode="after")
    def _is_in_place(self) -> BoardEntry:
        T = self.matrix
        shift = float(np.linalg.norm(T[:3, 3]))
        turn = float(np.arccos(np.clip((np.trace(T[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)))
        if shift + BOARD_LEVER_M * turn > BOARD_M:
            raise ValueError(
                f"the board lies {1e3 * shift:.1f} mm and {np.degrees(turn):.1f} degrees from "
                "where the calibration has it, and so do its pegs; register it with `viskill "
                "calibrate fit FOLDER --calibration OLD -o NEW`, and measure the scene with that"
            )
        return self


class SceneFile(Table):
    """`scene.toml`: the things on the board of a cell, which one to move, and where to."""

    schema_version: Literal[1] = Field(alias="schema")
    cell: str
    active: str
    goal_m: Vector3
    board: BoardEntry | None = None
    object: tuple[ObjectEntry, ...] = Field(min_length=1)

    @field_validator("goal_m")
    @classmethod
    def _is_near(cls, goal: Vector3) -> Vector3:
        return _near(goal)

    @model_validator(mode="after")
    def _names(self) -> SceneFile:
        names = [thing.name for thing in self.object]
        if len(set(names)) != len(names):
            raise ValueError(f"two objects share a name: {names}")
        if self.active not in names:
            raise ValueError(f"active is {self.active!r}; the file has the objects {names}")
        return self


@dataclass(frozen=True)
class SeenScene:
    """A scene that somebody has measured.

    Attributes:
        path: its file.
        scene: where the things are.
        covariance: of every thing's pose, by name, (6, 6).
    """

    path: Path
    scene: Scene
    covariance: Mapping[str, FloatArray]


def read_scene(path: Path, cell: str) -> SeenScene:
    """The scene in a file.

    Args:
        path: the file.
        cell: name of the cell in whose task frame it has to be.

    Raises:
        DataFileError: names the file, the key and what is wrong.
    """
    file = read_toml(path, SceneFile)
    if file.cell != cell:
        raise DataFileError(path, "cell", f"is {file.cell!r}, this run is in {cell!r}")
    poses = tuple(thing.pose for thing in file.object)
    spread = {thing.name: thing.spread for thing in file.object}
    return SeenScene(path, Scene(0.0, poses, file.active, np.array(file.goal_m)), spread)


def write_scene(path: Path, file: SceneFile) -> Path:
    """Writes a scene file that `read_scene` reads back, and people can edit; returns its path."""
    content = file.model_dump(by_alias=True, exclude_none=True)
    board, things = content.pop("board", None), content.pop("object")
    lines = [_entry(key, value) for key, value in content.items()]
    for table, entries in (("[board]", [board] if board else []), ("[[object]]", things)):
        for entry in entries:
            named = sorted(entry.items(), key=lambda item: item[0] != "name")
            lines += ["", table, *(_entry(key, value) for key, value in named)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _entry(key: str, value: Any) -> str:
    if key == "covariance":
        rows = "\n".join(f"  {json.dumps(row)}," for row in value)
        return f"{key} = [\n{rows}\n]"
    return f"{key} = {json.dumps(value)}"


def _near(position: Vector3) -> Vector3:
    if max(map(abs, position)) > FARTHEST_M:
        raise ValueError(f"{position} is farther than 1 m from the task frame; positions are in m")
    return position
