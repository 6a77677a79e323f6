"""Trajectories in the files that people have: CSV, npz, and bags (MCAP, rosbag2, ROS 1).

A file may say itself what its numbers mean (frame, control point, length scale); what this module
writes always does.
"""

from __future__ import annotations

import csv
import io
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from viskill_deploy.core.description import rpy_matrix
from viskill_deploy.core.errors import MotionError, RecordingError
from viskill_deploy.core.new_files import new_file
from viskill_deploy.core.types import FloatArray
from viskill_deploy.motion.frames import Frame
from viskill_deploy.motion.trajectory import ArmPath, Written, quaternions
from viskill_deploy.observe import layout
from viskill_deploy.observe.mcap_file import McapFile, write_metadata
from viskill_deploy.observe.messages import JOINT_STATE, POSE_STAMPED
from viskill_deploy.observe.trajectory_bags import read_bag
from viskill_deploy.observe.trajectory_labels import LABEL_KEYS, label_of, label_texts

ORIGIN_NS = 10**9
"""Stamp of a bag's first message: 0 would mean that there is none."""

MAX_BYTES = 256 * 2**20
POSITION, QUATERNION, EULER = ("x", "y", "z"), ("qx", "qy", "qz", "qw"), ("roll", "pitch", "yaw")


def read_written(path: Path, arms: Sequence[str] = (), frame: Frame | None = None) -> Written:
    """The trajectory in a file.

    Args:
        path: a .csv, a .npz, or a bag.
        arms: the arms to read out of a bag; all that are there when empty.
        frame: as `read_bag` takes it.

    Raises:
        MotionError: the file holds no trajectory; says what is missing.
    """
    kind = path.suffix.lower()
    if not path.exists():
        raise MotionError(f"{path}: there is no such file; check the path")
    if path.is_file() and path.stat().st_size > MAX_BYTES:
        raise MotionError(f"{path}: is too large for a trajectory; cut it down to waypoints")
    if kind == ".csv":
        return _read_csv(path)
    if kind == ".npz":
        return _read_npz(path)
    if path.is_dir() or kind in {".mcap", ".bag", ".db3"}:
        return read_bag(path, arms, frame)
    raise MotionError(f"{path}: is no .csv, .npz, .mcap, .bag or folder of a bag")


def write_written(path: Path, written: Written) -> None:
    """Writes a trajectory; the name's ending says how (.csv, .npz, none for a bag's folder).

    Raises:
        MotionError: another ending.
        RecordingError: the file, or the bag's folder, exists.
    """
    label = label_texts(written.label)
    if path.suffix == ".csv":
        new_file(path).write_text(_csv_text(written, label), encoding="utf-8")
    elif path.suffix == ".npz":
        arrays: dict[str, Any] = {} if written.time_s is None else {"time_s": written.time_s}
        for name, arm in written.arms.items():
            arrays |= {f"{name}/position": arm.position, f"{name}/quaternion": arm.quaternion}
            arrays[f"{name}/jaw"] = arm.jaw
        np.savez(new_file(path), **(arrays | label))
    elif path.suffix == "":
        _write_bag(path, written, label)
    else:
        raise MotionError(f"{path}: name a .csv, a .npz, or a folder for a bag")


def _csv_text(written: Written, label: Mapping[str, str]) -> str:
    out = io.StringIO()
    out.writelines(f"# {key}: {value}\n" for key, value in label.items())
    names, columns = [], []
    if written.time_s is not None:
        names, columns = ["time_s"], [written.time_s]
    for name, arm in written.arms.items():
        names += [f"{name}.{part}" for part in (*POSITION, *QUATERNION, "jaw")]
        columns += [*arm.position.T, *arm.quaternion.T, arm.jaw]
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([repr(float(x)) for x in row] for row in np.column_stack(columns))
    return out.getvalue()


def _read_csv(path: Path) -> Written:
    """Columns `time_s` (optional) and `<arm>.x … .jaw`, comments `# key: value` before them."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise MotionError(f"{path}: cannot be read as text ({error})") from error
    said = [line[1:].partition(":") for line in lines if line.startswith("#")]
    texts = {key.strip().lower(): value.strip() for key, _, value in said}
    numbered = [(i, line) for i, line in enumerate(lines, 1) if line and not line.startswith("#")]
    if len(numbered) < 2:
        raise MotionError(f"{path}: has no rows; the first line names the columns")
    names = [name.strip() for name in numbered[0][1].split(",")]
    if len(set(names)) != len(names):
        raise MotionError(f"{path}: names a column twice")
    rows = []
    for number, line in numbered[1:]:
        cells = line.split(",")
        try:
            row = [float(cell) for cell in cells]
        except ValueError as error:
            raise MotionError(f"{path}, line {number}: {error}") from error
        if len(row) != len(names):
            raise MotionError(f"{path}, line {number}: {len(row)} numbers for {len(names)} columns")
        rows.append(row)
    table = dict(zip(names, np.array(rows).T, strict=True))
    time_s = table.pop("time_s", None)
    arms = {name.rpartition(".")[0]: None for name in table}
    paths = {arm: _csv_arm(path, arm, table) for arm in arms}
    if table:
        raise MotionError(f"{path}: does not know the columns {', '.join(table)}")
    return Written(time_s, paths, label_of(texts, path))


def _csv_arm(path: Path, arm: str, table: dict[str, FloatArray]) -> ArmPath:
    """Takes an arm's columns out of a table."""

    def take(parts: Sequence[str]) -> FloatArray:
        missing = [part for part in parts if f"{arm}.{part}" not in table]
        if missing:
            raise MotionError(
                f"{path}: lacks the columns {', '.join(f'{arm}.{part}' for part in missing)}"
            )
        return np.column_stack([table.pop(f"{arm}.{part}") for part in parts])

    position = take(POSITION)
    if f"{arm}.roll" in table:
        turned = np.array([rpy_matrix(*row) for row in take(EULER).tolist()])
        return ArmPath(position, quaternions(turned), take(["jaw"])[:, 0])
    return ArmPath(position, take(QUATERNION), take(["jaw"])[:, 0])


def _read_npz(path: Path) -> Written:
    """Arrays `time_s` (optional), `<arm>/position`, `/quaternion`, `/jaw`, and texts."""
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(info.file_size for info in archive.infolist()) > MAX_BYTES:
                raise MotionError(f"{path}: is too large for a trajectory; cut it down")
        with np.load(path, allow_pickle=False) as content:
            arrays = {name: content[name] for name in content.files}
    except Exception as error:  # of any kind, on damaged files: numpy parses, zlib unpacks
        raise MotionError(f"{path}: is no npz file of plain arrays ({error})") from error
    texts = {key: str(arrays.pop(key)) for key in LABEL_KEYS if key in arrays}
    time_s = _numbers(path, "time_s", arrays.pop("time_s")) if "time_s" in arrays else None
    paths = {}
    for arm in dict.fromkeys(name.rpartition("/")[0] for name in arrays):
        parts = []
        for part in ("position", "quaternion", "jaw"):
            parts.append(_numbers(path, f"{arm}/{part}", arrays.get(f"{arm}/{part}")))
        paths[arm] = ArmPath(*parts)
    return Written(time_s, paths, label_of(texts, path))


def _numbers(path: Path, name: str, values: object) -> FloatArray:
    """An array of a file, if it holds numbers."""
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "fiu":
        raise MotionError(f"{path}: lacks the numbers {name}")
    return np.asarray(values, dtype=np.float64)


def _write_bag(folder: Path, written: Written, label: Mapping[str, str]) -> None:
    poses, joints = {}, {}
    for name, arm in written.arms.items():
        poses[f"/{name}/setpoint_cp"] = np.hstack([arm.position, arm.quaternion])
        jaw = arm.jaw[:, None]
        joints[f"/{name}/jaw/setpoint_js"] = JointColumn(("jaw",), jaw, np.zeros_like(jaw))
    count = len(next(iter(poses.values())))
    time_s = np.arange(float(count)) if written.time_s is None else written.time_s
    write_bag(folder, time_s, poses, joints, label)


@dataclass(frozen=True)
class JointColumn:
    """Joints of one topic over time: names, positions and velocities (n, joints)."""

    names: tuple[str, ...]
    position: FloatArray
    velocity: FloatArray


def write_bag(
    folder: Path,
    time_s: FloatArray,
    poses: Mapping[str, FloatArray],
    joints: Mapping[str, JointColumn],
    metadata: Mapping[str, str],
) -> None:
    """A rosbag2 folder with one MCAP file.

    Args:
        folder: new.
        time_s: since the first message, (n,).
        poses: position and quaternion (n, 7) by topic, for PoseStamped.
        joints: by topic, for JointState.
        metadata: entries of the file's metadata record; "frame" is the poses' frame id.

    Raises:
        RecordingError: the folder exists.
    """
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise RecordingError(f"{folder}: cannot be made ({error}); name a new folder") from error
    name = f"{folder.name}_0.mcap"
    file = McapFile(folder / name, metadata)
    log = np.rint(time_s * 1e9).astype(np.int64) + ORIGIN_NS
    for topic, values in poses.items():
        made = layout.pose_stamped(metadata.get("frame", ""))
        column = made.column(file.channel(topic, POSE_STAMPED))
        records = column.records(log, log)
        records["position"], records["orientation"] = values[:, :3], values[:, 3:]
        file.add(column.channel, records)
    for topic, rows in joints.items():
        column = layout.joint_state(rows.names).column(file.channel(topic, JOINT_STATE))
        records = column.records(log, log)
        for field, values in (("position", rows.position), ("velocity", rows.velocity)):
            records[field] = values if len(rows.names) > 1 else values[:, 0]
        file.add(column.channel, records)
    file.finish()
    write_metadata(folder, file, name)


def write_joint_plan(
    path: Path, period_s: float, table: FloatArray, arms: Sequence[JointNames]
) -> None:
    """Writes a smoothed plan for a player of joint setpoints, by the name's ending as above.

    Args:
        path: .csv, .npz, or a bag's folder.
        period_s: time between two rows.
        table: positions and velocities of every axis, jaw last, (n, arms, 2, axes).
        arms: name of every arm, and of its axes.

    Raises:
        MotionError: another ending.
        RecordingError: the file, or the bag's folder, exists.
    """
    time_s: FloatArray = period_s * np.arange(1, len(table) + 1, dtype=np.float64)
    if path.suffix == ".csv":
        names = [
            f"{arm.name}.{part}{joint}" for arm in arms for part in ("", "v_") for joint in arm.axes
        ]
        out = io.StringIO()
        writer = csv.writer(out, lineterminator="\n")
        writer.writerow(["time_s", *names])
        rows = np.column_stack([time_s, table.reshape(len(table), -1)])
        writer.writerows([repr(x) for x in row] for row in rows.tolist())
        new_file(path).write_text(out.getvalue(), encoding="utf-8")
    elif path.suffix == ".npz":
        arrays: dict[str, Any] = {"time_s": time_s}
        for index, arm in enumerate(arms):
            arrays |= {f"{arm.name}/axes": np.array(arm.axes)}
            arrays[f"{arm.name}/position"] = table[:, index, 0]
            arrays[f"{arm.name}/velocity"] = table[:, index, 1]
        np.savez(new_file(path), **arrays)
    elif path.suffix == "":
        joints = {}
        for index, arm in enumerate(arms):
            for topic, columns in (("servo_jp", slice(0, -1)), ("jaw/servo_jp", slice(-1, None))):
                joints[f"/{arm.name}/{topic}"] = JointColumn(
                    arm.axes[columns], table[:, index, 0, columns], table[:, index, 1, columns]
                )
        write_bag(path, time_s, {}, joints, {"kind": "joint plan"})
    else:
        raise MotionError(f"{path}: name a .csv, a .npz, or a folder for a bag")


@dataclass(frozen=True)
class JointNames:
    """An arm and its axes, jaw last."""

    name: str
    axes: tuple[str, ...]
