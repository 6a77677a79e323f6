"""Waypoints in the task frame to joint positions of every arm, and back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio

from viskill_deploy.core.cables import STIFF, WRIST
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import KinematicsError, MotionError
from viskill_deploy.core.types import FloatArray, Waypoint
from viskill_deploy.kinematics.closed_form import inverse_batch
from viskill_deploy.kinematics.model import forward_batch
from viskill_deploy.kinematics.straight import placed_arm

CHORD_M, CHORD_RAD = 0.009, 0.55
"""Waypoints farther apart than this get others between them, so that the tip follows the chord."""

MAX_DENSE = 200_000
"""A path of more waypoints than this, with those added, is a mistake in units."""


def task_poses(cell: CellDescription, arm: int, q: FloatArray) -> FloatArray:
    """T_task_tip of one arm for joint positions (n, joints), as (n, 4, 4)."""
    poses: FloatArray = cell.arms[arm].T_task_base @ forward_batch(cell.arms[arm].arm, q)
    return poses


def base_poses(cell: CellDescription, arm: int, T_task_tip: FloatArray) -> FloatArray:
    """T_base_tip of one arm for task-frame poses (n, 4, 4)."""
    base = cell.arms[arm].T_task_base
    inverse = np.eye(4)
    inverse[:3, :3] = base[:3, :3].T
    inverse[:3, 3] = -base[:3, :3].T @ base[:3, 3]
    poses: FloatArray = inverse @ T_task_tip
    return poses


def waypoint_at(cell: CellDescription, axes: Sequence[Sequence[float]] | FloatArray) -> Waypoint:
    """The waypoint at which the arms stand, from axis positions (axes,) an arm, jaw last."""
    rows = np.array(axes, dtype=np.float64)
    for row, arm in zip(rows, cell.arms, strict=True):
        if arm.cables != STIFF:
            row[WRIST] += arm.cables.error(row[:-1], np.zeros(3))
    return Waypoint(
        tuple(task_poses(cell, i, rows[i : i + 1, :-1])[0] for i in range(len(cell.arms))),
        tuple(rows[:, -1].tolist()),
        cell.file.motion.step_s,
    )


def resolve(
    cell: CellDescription,
    waypoints: Sequence[Waypoint],
    start: Sequence[Sequence[float]],
    names: Sequence[str] = (),
) -> FloatArray:
    """Axis positions at the start and at every waypoint, (1 + n, arms, axes).

    Args:
        cell: the arms in their places.
        waypoints: where the tips shall be.
        start: present axis positions, (axes,) an arm; roll turns follow on from them.
        names: what people call the waypoints; "waypoint 1" and so on when empty.

    Raises:
        MotionError: a waypoint is out of an arm's reach, or the roll would have to unwind; names
            arm and waypoint.
    """
    names = names or [f"waypoint {i + 1}" for i in range(len(waypoints))]
    q = np.empty((1 + len(waypoints), len(cell.arms), cell.arms[0].arm.axes))
    q[0] = start
    for index, arm in enumerate(cell.arms):
        poses = np.array([w.T_task_tip[index] for w in waypoints])
        q[1:, index, -1] = [w.jaw[index] for w in waypoints]
        if not arm.arm.has_remote_centre:
            q[1:, index, :-1] = _one_by_one(cell, index, poses, q[0, index, :-1], names)
            continue
        seeds = np.broadcast_to(q[0, index, :6], (len(waypoints), 6))
        solved, reached = inverse_batch(arm.arm, base_poses(cell, index, poses), seeds)
        if not reached.all():
            where = int(np.flatnonzero(~reached)[0])
            raise MotionError(
                f"{names[where]} is out of {arm.name}'s reach; check the task frame and units"
            )
        q[1:, index, :6] = solved
        q[:, index, 3] = _unwrapped(q[:, index, 3], arm.arm.limit(0)[3], arm.arm.limit(1)[3])
        turned = np.flatnonzero(np.abs(np.diff(q[:, index, 3])) > np.pi)
        if len(turned):
            raise MotionError(
                f"{arm.name}'s roll reaches its limit before {names[turned[0]]} and would have to "
                "turn back a whole turn; start with the roll a turn away, or rotate the path"
            )
        if arm.cables != STIFF:
            q[:, index, :6] = arm.cables.along(q[:, index, :6])
    return q


def _one_by_one(
    cell: CellDescription,
    index: int,
    poses: FloatArray,
    start: FloatArray,
    names: Sequence[str],
) -> FloatArray:
    """Joints of an arm without a closed form along a path, each pose from the one before."""
    arm, rows = placed_arm(cell.arms[index]), [start]
    for pose, name in zip(base_poses(cell, index, poses), names, strict=True):
        try:
            rows.append(arm.inverse(pose, rows[-1]))
        except KinematicsError as error:
            raise MotionError(f"{cell.arms[index].name}, {name}: {error}") from error
    return np.array(rows[1:]).reshape(len(poses), len(start))


def start_seeds(cell: CellDescription) -> list[tuple[float, ...]]:
    """Axis positions near which the cell's start pose is looked for, jaw last."""
    return [(*arm.seed, 0.0) for arm in cell.arms]


def _unwrapped(roll: FloatArray, lower: float, upper: float) -> FloatArray:
    """Roll angles with every turn nearest to the angle before it, where the limits allow."""
    turns = np.array([-2.0, -1.0, 0.0, 1.0, 2.0]) * 2 * np.pi
    result = roll.copy()
    for i in range(1, len(roll)):
        options = roll[i] + turns
        options = options[(options >= lower) & (options <= upper)]
        if len(options):
            result[i] = options[np.argmin(np.abs(options - result[i - 1]))]
    return result


def densified(waypoints: Sequence[Waypoint]) -> list[Waypoint]:
    """The same path with waypoints added, as `densified_rows` adds them."""
    return densified_rows(waypoints)[0]


def densified_rows(waypoints: Sequence[Waypoint]) -> tuple[list[Waypoint], list[int]]:
    """The same path with waypoints added, so that no step is longer than 9 mm or 0.55 rad.

    Positions are interpolated along the chord, orientations along the shortest rotation; each added
    step is meant to take `step_s` like any other. The jaw moves in the last part of its step.

    Returns:
        The waypoints, and for each the index of the one given that it is, or leads to.

    Raises:
        MotionError: the path is so long that it would need more than `MAX_DENSE`.
    """
    dense, rows = list(waypoints[:1]), [0] * len(waypoints[:1])
    for row, goal in enumerate(waypoints[1:], 1):
        last = dense[-1]
        pairs = list(zip(last.T_task_tip, goal.T_task_tip, strict=True))
        parts = max(1, *(_parts(a, b) for a, b in pairs))
        if len(dense) + parts > MAX_DENSE:
            raise MotionError(
                f"the path is too long: it needs a waypoint every {1e3 * CHORD_M:.0f} mm, and more "
                f"than {MAX_DENSE} in all; check the units"
            )
        rows += [row] * parts
        for part in range(1, parts + 1):
            dense.append(
                Waypoint(
                    tuple(between(a, b, part / parts) for a, b in pairs),
                    goal.jaw if part == parts else last.jaw,
                    goal.step_s,
                    goal.skill,
                    goal.may_open_jaw,
                    goal.observation,
                )
            )
    return dense, rows


def _parts(a: FloatArray, b: FloatArray) -> int:
    distance = float(np.linalg.norm(b[:3, 3] - a[:3, 3]))
    angle = float(np.linalg.norm(pinocchio.log3(a[:3, :3].T @ b[:3, :3])))
    parts = max(distance / CHORD_M, angle / CHORD_RAD)  # may be infinite
    return int(min(np.ceil(parts - 1e-9), MAX_DENSE))


def between(a: FloatArray, b: FloatArray, share: float) -> FloatArray:
    """The pose at a part of the chord from `a` to `b`, turned by that part of the way, (4, 4)."""
    pose = np.eye(4)
    pose[:3, 3] = a[:3, 3] + share * (b[:3, 3] - a[:3, 3])
    pose[:3, :3] = a[:3, :3] @ pinocchio.exp3(share * pinocchio.log3(a[:3, :3].T @ b[:3, :3]))
    return pose
