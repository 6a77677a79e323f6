"""From a policy's action to the next waypoint. One policy step is one waypoint.

The learning world and the runtime both call `apply_action`: a policy runs as it was trained.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import MotionError
from viskill_deploy.core.types import FloatArray, Waypoint

ACTION_SIZE = 5
"""Numbers an arm: displacement x, y, z, rotation, jaw; each in [-1, 1]."""

WORKSPACE_INSET_M = 0.003
"""Waypoints stay this far inside the gate's workspace: a corner may be cut by less."""

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
        rotation_rad: yaw about the task frame's z for 1.0.
        jaw_open_rad: opening for a jaw action >= 0; below 0 the jaw closes to the grip angle. Wide
            enough for a wall of a block, and no wider: at 0.6 the finger inside the hole met the
            peg on its way down and was held back by up to 5 mm.
    """

    reference: Literal["setpoint", "measured"] = "setpoint"
    displacement_m: float = 0.010
    max_displacement_m: float = 0.009
    rotation_rad: float = math.pi / 6
    jaw_open_rad: float = 0.5


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


def start_waypoint(cell: CellDescription, spec: ActionSpec) -> Waypoint:
    """The cell's start pose, jaws closed, as a waypoint."""
    entries = [arm.entry for arm in cell.arms]
    return Waypoint(
        T_task_tip=tuple(downward_pose(e.start_position_m, e.start_yaw_rad) for e in entries),
        jaw=tuple(arm.arm.jaw.grip_angle_rad for arm in cell.arms),
        step_s=cell.file.motion.step_s,
    )


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
        poses.append(downward_pose(target, yaw_of(base) + spec.rotation_rad * float(a[3])))
        closed = a[4] < 0
        jaws.append(arm.arm.jaw.grip_angle_rad if closed else spec.jaw_open_rad)
    return Waypoint(tuple(poses), tuple(jaws), last.step_s, skill, may_open_jaw)
