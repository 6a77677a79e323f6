"""Poses of a tool as different programs write them, and the one that this project means.

Three things differ from program to program, and each is worth a silent error: the frame with its
scale, the axes of the tool, and the point of the tool that a position is about.

frame    origin                     unit  axes of the tool
task     the cell's task frame      m     CRTK tip: z forward, x the axis that the jaws open about
crtk     the arm's remote centre    m     CRTK tip: what `local/measured_cp` reports
rcm      the arm's remote centre    m     EEF: y forward, z along the jaws' hinge
world    SurRoL's world             m     EEF
surrol   SurRoL's world             5 m   EEF: what SurRoL and the official code print
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from viskill_deploy.core.description import CellArm, CellDescription
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.core.types import FloatArray

Frame = Literal["task", "crtk", "rcm", "world", "surrol"]
ControlPoint = Literal["jaw-pivot", "jaw-end"]
FRAMES: tuple[Frame, ...] = get_args(Frame)
CONTROL_POINTS: tuple[ControlPoint, ...] = get_args(ControlPoint)

TIP_AXES: tuple[Frame, ...] = ("task", "crtk")
"""Frames whose poses have the axes of the CRTK tip; the others have those of the EEF."""

ARM_FRAMES: tuple[Frame, ...] = ("crtk", "rcm")


@dataclass(frozen=True, slots=True)
class Label:
    """What the numbers of a pose mean.

    Attributes:
        frame: where it is seen from, and the axes of the tool.
        control_point: "jaw-pivot" (origin of the wrist-yaw axis) or "jaw-end", a jaw's length on.
        length_scale: lengths over metres; the frame's own by default.
    """

    frame: Frame
    control_point: ControlPoint
    length_scale: float | None = None

    def __str__(self) -> str:
        scale = "" if self.length_scale is None else f", lengths x {self.length_scale:g}"
        return f"frame {self.frame}, control point {self.control_point}{scale}"

    def but(self, **changes: object) -> Label:
        """The same label with something else in it."""
        return replace(self, **changes)  # type: ignore[arg-type]


def to_task(cell: CellDescription, arm: int, label: Label, poses: FloatArray) -> FloatArray:
    """T_task_tip at the jaw pivot from poses as labelled.

    Args:
        cell: the arms in their places.
        arm: index of the arm whose tool it is.
        label: what the numbers mean.
        poses: (..., 4, 4).

    Raises:
        DataFileError: the cell does not say where SurRoL's world is.
    """
    entry = cell.arms[arm]
    result = np.array(poses, dtype=np.float64)
    result[..., :3, 3] /= _scale(cell, label)
    if label.frame not in TIP_AXES:
        result[..., :3, :3] = result[..., :3, :3] @ entry.arm.tip_rotation
    result = _T_task_frame(cell, entry, label.frame) @ result
    result[..., :3, 3] -= _reach(entry, label) * result[..., :3, 2]
    return result


def from_task(cell: CellDescription, arm: int, label: Label, poses: FloatArray) -> FloatArray:
    """Poses as a label wants them, from T_task_tip at the jaw pivot; the inverse of `to_task`."""
    entry = cell.arms[arm]
    result = np.array(poses, dtype=np.float64)
    result[..., :3, 3] += _reach(entry, label) * result[..., :3, 2]
    result = np.linalg.inv(_T_task_frame(cell, entry, label.frame)) @ result
    if label.frame not in TIP_AXES:
        result[..., :3, :3] = result[..., :3, :3] @ entry.arm.tip_rotation.T
    result[..., :3, 3] *= _scale(cell, label)
    return result


def _reach(entry: CellArm, label: Label) -> float:
    """From the jaw pivot to the control point along the tip's z, m."""
    return entry.arm.jaw.finger_length_m if label.control_point == "jaw-end" else 0.0


def _scale(cell: CellDescription, label: Label) -> float:
    if label.length_scale is not None:
        return label.length_scale
    if label.frame != "surrol":
        return 1.0
    return _surrol(cell)[0]


def _T_task_frame(cell: CellDescription, entry: CellArm, frame: Frame) -> FloatArray:
    """Pose of a frame in the task frame."""
    if frame in ARM_FRAMES:
        return entry.T_task_base
    pose = np.eye(4)
    if frame != "task":
        pose[:3, 3] = -_surrol(cell)[1]
    return pose


def _surrol(cell: CellDescription) -> tuple[float, FloatArray]:
    world = cell.file.surrol
    if world is None:
        raise DataFileError(
            cell.files[0],
            "surrol",
            "missing: the cell does not say where SurRoL's world is; add it",
        )
    return world.length_scale, np.array(world.task_origin_m)
