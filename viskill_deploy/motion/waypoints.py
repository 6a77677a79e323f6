"""From a policy's action to the next waypoint. One policy step is one waypoint.

The learning world and the runtime both call `apply_action`: a policy runs as it was trained.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from viskill_deploy.core.cell_files import Rotation
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import MotionError
from viskill_deploy.core.types import FloatArray, Waypoint

ACTION_SIZE = 5
"""Numbers an arm: displacement x, y, z, rotation, jaw; each in [-1, 1]."""

WORKSPACE_INSET_M = 0.003
"""Waypoints stay this far inside the gate's workspace: a corner may be cut by less."""

PITCH_MODE_TILT_RAD = math.radians(15.0)
"""In pitch mode the tool points this far below the horizontal, at a pitch of 0."""

PITCH_UNIT_RAD = math.pi / 12

BASE_TOLERANCE_M = 0.005
"""Actions build on the commanded waypoint, at most this far from the measured tip."""


@dataclass(frozen=True, slots=True)
class ActionSpec:
    """How the numbers of an action are meant; part of a bundle's manifest.

    Attributes:
        reference: what a displacement is added to: the last waypoint ("setpoint") or the measured
            tip ("measured", official ViSkill checkpoints).
        displacement_m: length of 1.0 on one axis.
        max_displacement_m: the displacement vector is shortened to this.
        rotation_rad: turn for 1.0 of an arm in yaw mode, about the task frame's z.
        jaw_open_rad: opening for a jaw action >= 0; below 0 the jaw closes to the grip angle. Wide
            enough for a wall of a block, and no wider: at 0.6 the finger inside the hole met the
            peg on its way down and was held back by up to 5 mm.
        rotation: which angle the rotation commands, for every arm or one an arm. "yaw": the tool
            points straight down. "pitch": it points towards -y, 15 degrees down, and turns about
            the task frame's y, by at most 90 degrees either way.
        pitch_rad: turn for 1.0 of an arm in pitch mode.
    """

    reference: Literal["setpoint", "measured"] = "setpoint"
    displacement_m: float = 0.010
    max_displacement_m: float = 0.009
    rotation_rad: float = math.pi / 6
    jaw_open_rad: float = 0.5
    rotation: Rotation | tuple[Rotation, ...] = "yaw"
    pitch_rad: float = PITCH_UNIT_RAD

    def mode(self, arm: int) -> Rotation:
        """Which angle the rotation of an arm commands."""
        return self.rotation if isinstance(self.rotation, str) else self.rotation[arm]


def downward_pose(position: Sequence[float] | FloatArray, yaw: float) -> FloatArray:
    """Pose of a tip that points straight down, (4, 4).

    Args:
        position: control point, task frame, m.
        yaw: yaw of the ViSkill EEF frame (fixed-axis rpy = (-pi/2, 0, yaw)), rad.
    """
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array(
        [
            [s, -c, 0.0, position[0]],
            [-c, -s, 0.0, position[1]],
            [0.0, 0.0, -1.0, position[2]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def yaw_of(T_task_tip: FloatArray) -> float:
    """Yaw of the EEF frame whose x axis is minus the tip's y axis, rad."""
    return math.atan2(-T_task_tip[1, 1], -T_task_tip[0, 1])


def pitched_pose(position: Sequence[float] | FloatArray, pitch: float) -> FloatArray:
    """Pose of a tip in pitch mode, (4, 4).

    Args:
        position: control point, task frame, m.
        pitch: pitch of the ViSkill EEF frame (fixed-axis rpy = (-pi/12, pitch, -pi)), rad.
    """
    (c, s), (ct, st) = ((math.cos(a), math.sin(a)) for a in (pitch, PITCH_MODE_TILT_RAD))
    return np.array(
        [
            [s * ct, c, s * st, position[0]],
            [st, 0.0, -ct, position[1]],
            [-c * ct, s, -c * st, position[2]],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def pitch_of(T_task_tip: FloatArray) -> float:
    """Pitch of the EEF frame whose x axis is minus the tip's y axis, rad, in [-pi/2, pi/2]."""
    _, y, z = -T_task_tip[:3, 1]
    return math.atan2(-z, math.hypot(T_task_tip[0, 1], y))


def start_waypoint(cell: CellDescription) -> Waypoint:
    """The cell's start pose, jaws closed, as a waypoint."""
    entries = [arm.entry for arm in cell.arms]
    return Waypoint(
        T_task_tip=tuple(_pose(e.rotation, e.start_position_m, e.start_angle_rad) for e in entries),
        jaw=tuple(arm.arm.jaw.grip_angle_rad for arm in cell.arms),
        step_s=cell.file.motion.step_s,
    )


def _pose(rotation: Rotation, position: Sequence[float] | FloatArray, angle: float) -> FloatArray:
    return (downward_pose if rotation == "yaw" else pitched_pose)(position, angle)


def _turned(
    base: FloatArray, position: FloatArray, arm: int, turn: float, spec: ActionSpec
) -> FloatArray:
    """The pose at a position after a turn of `turn` units from the pose `base`."""
    if spec.mode(arm) == "yaw":
        return downward_pose(position, yaw_of(base) + spec.rotation_rad * turn)
    pitch = pitch_of(base) + spec.pitch_rad * turn
    return pitched_pose(position, min(max(pitch, -math.pi / 2), math.pi / 2))


def apply_action(
    last: Waypoint,
    action: FloatArray,
    measured: Sequence[FloatArray],
    cell: CellDescription,
    spec: ActionSpec,
    skill: str = "",
    may_open_jaw: tuple[bool, ...] = (),
) -> Waypoint:
    """The waypoint that an action asks for.

    Args:
        last: the waypoint commanded before.
        action: five numbers an arm, (5 * arms,); clipped to [-1, 1].
        measured: T_task_tip of every arm as measured, (4, 4) each.
        cell: gives the workspace and the jaws.
        spec: meaning of the numbers.
        skill: name of the skill that acts.
        may_open_jaw: per arm, whether that skill may open a jaw that holds something.

    Raises:
        MotionError: a number of the action is not finite.
    """
    if not np.isfinite(action).all():
        raise MotionError("the policy answered with a number that is not finite; train it again")
    poses, jaws = [], []
    for index, arm in enumerate(cell.arms):
        a = np.clip(action[index * ACTION_SIZE : (index + 1) * ACTION_SIZE], -1.0, 1.0)
        seen = measured[index][:3, 3]
        base = last.T_task_tip[index] if spec.reference == "setpoint" else measured[index]
        lead = base[:3, 3] - seen
        away = float(np.sqrt(lead @ lead))
        origin = seen + lead * min(1.0, BASE_TOLERANCE_M / away) if away > 0 else seen
        move = a[:3] * spec.displacement_m
        length = float(np.sqrt(move @ move))
        if length > spec.max_displacement_m:
            move *= spec.max_displacement_m / length
        low = np.array(arm.entry.workspace_lower_m) + WORKSPACE_INSET_M
        high = np.array(arm.entry.workspace_upper_m) - WORKSPACE_INSET_M
        target = np.minimum(np.maximum(origin + move, low), high)
        poses.append(_turned(base, target, index, float(a[3]), spec))
        closed = a[4] < 0
        jaws.append(arm.arm.jaw.grip_angle_rad if closed else spec.jaw_open_rad)
    return Waypoint(tuple(poses), tuple(jaws), last.step_s, skill, may_open_jaw)
