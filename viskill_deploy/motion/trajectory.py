"""Trajectories of waypoints that came from elsewhere, in the task frame, as plan files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pinocchio
from pydantic import Field

from viskill_deploy.core import data
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DataFileError, MotionError
from viskill_deploy.core.new_files import new_file
from viskill_deploy.core.robot_files import Positive, Table, Vector3, validated
from viskill_deploy.core.types import FloatArray, Waypoint
from viskill_deploy.motion.frames import Label, from_task, to_task

SCHEMA = 2
MAX_WAYPOINTS = 100_000
UNIT_TOLERANCE = 1e-3
"""Quaternions may be this far from unit length: a file with four digits is."""

TIME_TOLERANCE = 0.01
"""Steps between waypoints may differ by this part of their mean: printed stamps are rounded."""


@dataclass(frozen=True)
class ArmPath:
    """What a file says of one arm, as it is written there.

    Attributes:
        position: (n, 3).
        quaternion: x, y, z, w, (n, 4).
        jaw: opening angle, rad, (n,).
    """

    position: FloatArray
    quaternion: FloatArray
    jaw: FloatArray


@dataclass(frozen=True)
class Written:
    """A trajectory as a file holds it.

    Attributes:
        time_s: one a waypoint, (n,); None where the file has none.
        arms: by name.
        label: what the numbers mean, as far as the file says it.
        notes: what people should know of how it was read.
    """

    time_s: FloatArray | None
    arms: Mapping[str, ArmPath]
    label: Label | None = None
    notes: tuple[str, ...] = ()


def quaternions(R: FloatArray) -> FloatArray:
    """Unit quaternions x, y, z, w of rotations (n, 3, 3), (n, 4)."""
    return np.array([pinocchio.Quaternion(rotation).coeffs() for rotation in R]).reshape(-1, 4)


def rotations(q: FloatArray) -> FloatArray:
    """Rotations (n, 3, 3) of quaternions x, y, z, w (n, 4) of any length but zero."""
    x, y, z, w = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def waypoints_of(
    cell: CellDescription, written: Written, label: Label, step_s: float | None, source: str
) -> list[Waypoint]:
    """The waypoints that a file means.

    Args:
        cell: whose arms are to follow; every one of them has to be in the file.
        written: what the file holds.
        label: what its numbers mean.
        step_s: time between two waypoints; from the file's stamps when None.
        source: the file's name, for messages.

    Raises:
        MotionError: another number of arms, rows or times, numbers that are not finite, no
            rotations, steps that are no time or not alike.
    """
    names = [arm.name for arm in cell.arms]
    if sorted(written.arms) != sorted(names):
        raise MotionError(
            f"{source} holds {', '.join(written.arms) or 'no arm'}; {cell.name} needs "
            f"{', '.join(names)}: name the columns or topics so"
        )
    count = np.size(next(iter(written.arms.values())).jaw)
    if not 0 < count <= MAX_WAYPOINTS:
        raise MotionError(f"{source} holds {count} waypoints; 1 to {MAX_WAYPOINTS} can be used")
    if written.time_s is not None and written.time_s.shape != (count,):
        raise MotionError(
            f"{source}: its times have the shape {written.time_s.shape} for {count} waypoints; "
            "give one each, or none"
        )
    poses, jaws = [], []
    for index, name in enumerate(names):
        path = written.arms[name]
        _check(path, count, name, source)
        pose = np.tile(np.eye(4), (count, 1, 1))
        pose[:, :3, :3], pose[:, :3, 3] = rotations(path.quaternion), path.position
        poses.append(to_task(cell, index, label, pose))
        jaws.append(path.jaw)
    step = _step(written.time_s, step_s, count, source, cell.file.motion.step_s)
    may_open = (True,) * len(names)
    return [
        Waypoint(
            tuple(pose[i] for pose in poses),
            tuple(float(jaw[i]) for jaw in jaws),
            step,
            "trajectory",
            may_open,
        )
        for i in range(count)
    ]


def written_of(cell: CellDescription, waypoints: Sequence[Waypoint], label: Label) -> Written:
    """Waypoints as a file with that label holds them."""
    arms = {}
    for index, arm in enumerate(cell.arms):
        tips = np.array([w.T_task_tip[index] for w in waypoints])
        pose = from_task(cell, index, label, tips)
        jaw = np.array([w.jaw[index] for w in waypoints])
        arms[arm.name] = ArmPath(pose[:, :3, 3], quaternions(pose[:, :3, :3]), jaw)
    times: FloatArray = waypoints[0].step_s * np.arange(len(waypoints), dtype=np.float64)
    return Written(times, arms, label)


def _check(path: ArmPath, count: int, name: str, source: str) -> None:
    shapes = (path.position.shape, path.quaternion.shape, path.jaw.shape)
    if shapes != ((count, 3), (count, 4), (count,)):
        raise MotionError(f"{source}: {name} has {shapes} numbers for {count} waypoints")
    rows = np.column_stack([path.position, path.quaternion, path.jaw])
    if not np.isfinite(rows).all():
        where = 1 + int(np.flatnonzero(~np.isfinite(rows).all(axis=1))[0])
        raise MotionError(f"{source}: {name} has a number that is not finite at waypoint {where}")
    off = np.abs(np.linalg.norm(path.quaternion, axis=1) - 1.0)
    if off.max() > UNIT_TOLERANCE:
        raise MotionError(
            f"{source}: {name}'s quaternion at waypoint {1 + int(off.argmax())} has not length 1; "
            "the order is x, y, z, w"
        )


def _step(
    time_s: FloatArray | None, step_s: float | None, count: int, source: str, usual_s: float
) -> float:
    if step_s is not None:
        return step_s
    if time_s is None or count == 1:
        return usual_s
    steps = np.diff(time_s)
    mean = float(steps.mean())
    if not (np.isfinite(steps).all() and mean > 0.0):
        raise MotionError(f"{source}: its times do not rise; put its rows in order")
    if np.abs(steps - mean).max() > TIME_TOLERANCE * mean:
        raise MotionError(
            f"{source}: its steps are {steps.min():.4g} to {steps.max():.4g} s long; resample it "
            "to even steps, or say with --step how long each shall take"
        )
    return mean


class WaypointEntry(Table):
    """One waypoint: the tip of every arm at the jaw pivot, task frame, CRTK tip axes."""

    position_m: tuple[Vector3, ...]
    quaternion_xyzw: tuple[tuple[float, float, float, float], ...]
    jaw_rad: tuple[float, ...]


class PlanFile(Table):
    """`*.plan.json`: waypoints that `viskill dry-run` follows.

    Attributes:
        cell: name of the cell that they were made for.
        cell_sha256: `cell_sha256` of that cell.
    """

    schema_version: Literal[2] = Field(alias="schema")
    kind: Literal["trajectory"]
    cell: str
    cell_sha256: str
    arms: tuple[str, ...]
    step_s: Positive
    source: str
    waypoints: tuple[WaypointEntry, ...] = Field(min_length=1, max_length=MAX_WAYPOINTS)

    def unpacked(self) -> list[Waypoint]:
        """The waypoints."""
        may_open = (True,) * len(self.arms)
        result = []
        for entry in self.waypoints:
            R = rotations(np.array(entry.quaternion_xyzw))
            poses = np.tile(np.eye(4), (len(R), 1, 1))
            poses[:, :3, :3], poses[:, :3, 3] = R, entry.position_m
            result.append(
                Waypoint(tuple(poses), entry.jaw_rad, self.step_s, "trajectory", may_open)
            )
        return result


def cell_sha256(cell: CellDescription) -> str:
    """Hex SHA-256 over the cell's own file and those of its arms and tools, wherever they lie."""
    digests = [data.sha256(path) for path in cell.files]
    return hashlib.sha256("".join(digests).encode()).hexdigest()


def write_plan(
    path: Path, cell: CellDescription, waypoints: Sequence[Waypoint], source: str
) -> None:
    """Writes a plan file.

    Raises:
        RecordingError: the file exists.
    """
    written = written_of(cell, waypoints, Label("task", "jaw-pivot"))
    paths = [written.arms[arm.name] for arm in cell.arms]
    rows = [
        {
            "position_m": [p.position[i].tolist() for p in paths],
            "quaternion_xyzw": [p.quaternion[i].tolist() for p in paths],
            "jaw_rad": [float(p.jaw[i]) for p in paths],
        }
        for i in range(len(waypoints))
    ]
    head = {
        "schema": SCHEMA,
        "kind": "trajectory",
        "cell": cell.name,
        "cell_sha256": cell_sha256(cell),
        "arms": [arm.name for arm in cell.arms],
        "step_s": waypoints[0].step_s,
        "source": source,
    }
    lines = ",\n".join(json.dumps(row, allow_nan=False) for row in rows)
    text = json.dumps(head, allow_nan=False)[:-1] + ', "waypoints": [\n' + lines + "\n]}\n"
    new_file(path).write_text(text, encoding="utf-8")


def read_plan(path: Path) -> PlanFile:
    """A plan file; raises DataFileError."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise DataFileError(path, "", f"is no plan file ({error}); import it again") from error
    if isinstance(content, dict) and content.get("schema") != SCHEMA:
        raise DataFileError(
            path, "schema", f"is not {SCHEMA}: it lacks the digest of its cell; import it again"
        )
    plan = validated(path, PlanFile, content)
    count = len(plan.arms)
    for index, entry in enumerate(plan.waypoints):
        sizes = {len(entry.position_m), len(entry.quaternion_xyzw), len(entry.jaw_rad)}
        lengths = [sum(x * x for x in q) for q in entry.quaternion_xyzw]
        if sizes != {count} or any(abs(x - 1.0) > UNIT_TOLERANCE for x in lengths):
            raise DataFileError(
                path, f"waypoints.{index}", f"is no pose and jaw for {count} arms; import it again"
            )
    return plan
