"""`waypoints.apply_action` and `CellLinks` for many cells side by side: arrays instead of values.

Held equal to their scalar counterparts by tests. The first axis counts the environments.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import FloatArray, Waypoint
from viskill_deploy.kinematics.closed_form import inverse_batch
from viskill_deploy.motion.resolve import base_poses, task_poses
from viskill_deploy.motion.waypoints import (
    ACTION_SIZE,
    BASE_TOLERANCE_M,
    PITCH_MODE_TILT_RAD,
    WORKSPACE_INSET_M,
    ActionSpec,
)


@dataclass(frozen=True, slots=True)
class Waypoints:
    """One waypoint an environment.

    Attributes:
        T_task_tip: pose of every arm's tip, (N, arms, 4, 4), task frame, m.
        jaw: opening of every arm's jaw, (N, arms), rad.
    """

    T_task_tip: FloatArray
    jaw: FloatArray

    def row(self, index: int, step_s: float) -> Waypoint:
        """The waypoint of one environment."""
        return Waypoint(tuple(self.T_task_tip[index]), tuple(self.jaw[index].tolist()), step_s)


def tips(cell: CellDescription, joints: FloatArray) -> FloatArray:
    """T_task_tip of every arm, (N, arms, 4, 4), for joints (N, arms, 6)."""
    poses = [task_poses(cell, index, joints[:, index]) for index in range(len(cell.arms))]
    return np.stack(poses, axis=1)


def targets(
    cell: CellDescription, waypoints: Waypoints, present: FloatArray
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Axis positions at waypoints, (N, arms, 7), and which of them are within reach, (N,).

    Args:
        cell: the arms in their places.
        waypoints: where the tips shall be.
        present: axis positions now, (N, arms, 7); the roll turn nearest to them is taken.
    """
    axes = np.concatenate([present[..., :6], waypoints.jaw[..., None]], axis=-1)
    reached = np.ones(len(axes), dtype=bool)
    for index, arm in enumerate(cell.arms):
        poses = base_poses(cell, index, waypoints.T_task_tip[:, index])
        axes[:, index, :6], ok = inverse_batch(arm.arm, poses, present[:, index, :6])
        reached &= ok
    return axes, reached


def apply_actions(
    last: Waypoints,
    actions: FloatArray,
    measured: FloatArray,
    cell: CellDescription,
    spec: ActionSpec,
) -> Waypoints:
    """The waypoints that actions ask for; see `apply_action`.

    Args:
        last: the waypoints commanded before.
        actions: five numbers an arm, (N, 5 * arms), finite; clipped to [-1, 1].
        measured: T_task_tip of every arm as measured, (N, arms, 4, 4).
        cell: gives the workspace and the jaws.
        spec: meaning of the numbers.
    """
    a = np.clip(actions, -1.0, 1.0).reshape(len(actions), len(cell.arms), ACTION_SIZE)
    base = last.T_task_tip if spec.reference == "setpoint" else measured
    entries = [arm.entry for arm in cell.arms]
    low = np.array([entry.workspace_lower_m for entry in entries]) + WORKSPACE_INSET_M
    high = np.array([entry.workspace_upper_m for entry in entries]) - WORKSPACE_INSET_M
    seen = measured[..., :3, 3]
    origin = seen + _shortened(base[..., :3, 3] - seen, BASE_TOLERANCE_M)
    move = _shortened(a[..., :3] * spec.displacement_m, spec.max_displacement_m)
    place = np.clip(origin + move, low, high)
    poses = np.stack(
        [
            _turned(base[:, arm], place[:, arm], a[:, arm, 3], spec.mode(arm) == "yaw", spec)
            for arm in range(len(cell.arms))
        ],
        axis=1,
    )
    grip = np.array([arm.arm.jaw.grip_angle_rad for arm in cell.arms])
    return Waypoints(poses, np.where(a[..., 4] < 0, grip, spec.jaw_open_rad))


def _shortened(vectors: FloatArray, longest: float) -> FloatArray:
    """Vectors (..., 3) with none longer than `longest`."""
    length = np.sqrt((vectors**2).sum(axis=-1, keepdims=True))
    shorter: FloatArray = vectors * (longest / np.maximum(length, longest))
    return shorter


def _turned(
    base: FloatArray, place: FloatArray, turn: FloatArray, is_yaw: bool, spec: ActionSpec
) -> FloatArray:
    """Poses (N, 4, 4) at places (N, 3) after turns (N,), in units, from the poses `base`."""
    x, y, z = (-base[:, row, 1] for row in range(3))  # the EEF frame's x axis
    poses = np.zeros_like(base)
    poses[:, :3, 3], poses[:, 3, 3] = place, 1.0
    if is_yaw:
        angle = np.arctan2(y, x) + spec.rotation_rad * turn
        c, s = np.cos(angle), np.sin(angle)
        poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = s, -c, -c, -s
        poses[:, 2, 2] = -1.0
        return poses
    pitch = np.arctan2(-z, np.hypot(x, y)) + spec.pitch_rad * turn
    pitch = np.clip(pitch, -math.pi / 2, math.pi / 2)
    c, s = np.cos(pitch), np.sin(pitch)
    ct, st = math.cos(PITCH_MODE_TILT_RAD), math.sin(PITCH_MODE_TILT_RAD)
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 0, 2] = s * ct, c, s * st
    poses[:, 1, 0], poses[:, 1, 2] = st, -ct
    poses[:, 2, 0], poses[:, 2, 1], poses[:, 2, 2] = -c * ct, s, -c * st
    return poses
