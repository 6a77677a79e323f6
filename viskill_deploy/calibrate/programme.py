"""Poses to measure at: inside the limits and the workspace, and chosen for what they tell."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from viskill_deploy.calibrate.error_model import ErrorModel
from viskill_deploy.calibrate.fit import NOISE_M
from viskill_deploy.calibrate.measurements import Measurements
from viskill_deploy.calibrate.parameters import NAMES, USUAL
from viskill_deploy.core.arm_errors import rotation
from viskill_deploy.core.description import CellArm, CellDescription
from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.kinematics.closed_form import inverse_batch
from viskill_deploy.kinematics.model import tip_positions
from viskill_deploy.motion.resolve import base_poses
from viskill_deploy.motion.waypoints import WORKSPACE_INSET_M, start_waypoint

CANDIDATES = 3000
"""Random poses an arm that the programme is chosen from; not all can be reached."""

INSET_M = 0.008
"""Poses stay this far inside the workspace: an arm that is not calibrated is elsewhere by that."""

CLEAR_M = 0.016
"""And the end of the jaw this far above everything that stands in the cell: 99 of 100 arms that
nobody has calibrated reach less further down than their files say."""

WALL_M = 0.02
"""And this far from pegs that stick out of a wall, and from what hangs on them."""

TILT_RAD, TURN_RAD = 0.6, 1.0
"""How far the tool is tilted and turned away from the cell's start pose."""

APART_M = 0.012
"""And this far from the workspace of any other arm: all arms visit poses at the same time."""

LIMIT_MARGIN = 0.05
"""Joints stay this part of their range inside their limits."""

PAST_CANNULA_M = 0.005
"""And the wrist this much deeper than the gate asks."""


def choose_poses(cell: CellDescription, index: int, count: int, seed: int) -> FloatArray:
    """Joints of an arm to measure at, in the order in which they are visited, (count, 6).

    Candidates are drawn at random; those are taken, one by one, that add most to the determinant
    of the information about all parameters (D-optimal design, V. V. Fedorov, 1972). They are then
    visited by always going to the nearest one that is left.

    Raises:
        CalibrationError: the workspace leaves too few poses.
    """
    rng = np.random.default_rng([seed, index])
    q = _candidates(cell, index, rng)
    if len(q) < count:
        raise CalibrationError(
            f"{cell.arms[index].name}'s workspace leaves {len(q)} poses of {count}; ask for fewer"
        )
    n = len(q)
    turns = rng.choice([-1.0, 1.0], (n, 3))
    rows = Measurements(np.arange(float(n)), q, np.zeros((n, 6)), turns, np.zeros((n, 3)))
    chosen = most_telling(cell.arms[index], rows, count)
    return q[_tour(cell, index, q, chosen)]


def free_box(cell: CellDescription, arm: CellArm) -> tuple[FloatArray, FloatArray]:
    """Corners of where a jaw pivot has nothing around it, task frame, (3,) each, m."""
    low = np.array(arm.entry.workspace_lower_m) + INSET_M
    high = np.array(arm.entry.workspace_upper_m) - (INSET_M, INSET_M, WORKSPACE_INSET_M)
    file, heights = cell.file, [cell.file.motion.floor_m]
    if file.board is not None:
        heights.append(file.board.peg_height_m)
    if file.panel is not None:
        door_top = file.panel.door_height_m + file.panel.door_size_m[2] / 2
        heights.append(door_top + file.panel.handle_height_m + file.panel.handle_radius_m)
    if file.wall is not None:
        low[0] = max(low[0], file.wall.front_x_m + file.wall.peg_length_m + WALL_M)
    low[2] = max(low[2], max(heights) + arm.arm.jaw.finger_length_m + CLEAR_M)
    return low, high


def _candidates(cell: CellDescription, index: int, rng: np.random.Generator) -> FloatArray:
    """Random reachable poses in the free part of the workspace, as joints."""
    arm = cell.arms[index]
    low, high = free_box(cell, arm)
    start = start_waypoint(cell).T_task_tip[index]
    poses = np.tile(np.eye(4), (CANDIDATES, 1, 1))
    poses[:, :3, 3] = rng.uniform(low, high, (len(poses), 3))
    tilts = rng.uniform(-TILT_RAD, TILT_RAD, (len(poses), 2))
    turns = rng.uniform(-TURN_RAD, TURN_RAD, len(poses))
    for pose, (a, b), turn in zip(poses, tilts, turns, strict=True):
        pose[:3, :3] = rotation((a, b, turn)) @ start[:3, :3]
    home = inverse_batch(arm.arm, base_poses(cell, index, start[None]), np.zeros(6))[0]
    q, reached = inverse_batch(arm.arm, base_poses(cell, index, poses), home[0])
    lower, upper = np.array(arm.arm.limit(0)), np.array(arm.arm.limit(1))
    room = LIMIT_MARGIN * (upper - lower)
    inside = reached & (q >= lower + room).all(axis=1) & (q <= upper - room).all(axis=1)
    inside &= q[:, 2] >= arm.arm.insertion_min_m + PAST_CANNULA_M
    for other in cell.arms[:index] + cell.arms[index + 1 :]:
        inside &= _outside(poses[:, :3, 3], other)
    return np.asarray(q[inside])


def _outside(points: FloatArray, other: CellArm) -> npt.NDArray[np.bool_]:
    """Whether points keep clear of another arm's workspace, (n,)."""
    low = np.array(other.entry.workspace_lower_m) - APART_M
    high = np.array(other.entry.workspace_upper_m) + APART_M
    return np.asarray(((points < low) | (points > high)).any(axis=1))


def most_telling(arm: CellArm, rows: Measurements, count: int) -> list[int]:
    """Indices of `count` rows, greedily, by what each adds to the information."""
    _, J = ErrorModel(arm).linearised(np.zeros(len(NAMES)), rows)
    J = J * (USUAL / NOISE_M)
    inverse, left, chosen = np.eye(len(NAMES)), np.ones(len(rows), dtype=np.bool_), []
    for _ in range(count):
        gain = np.eye(3) + np.einsum("nai,ij,nbj->nab", J, inverse, J, optimize=True)
        best = int(np.argmax(np.where(left, np.linalg.det(gain), -1.0)))
        along = inverse @ J[best].T
        inverse = inverse - along @ np.linalg.solve(gain[best], along.T)
        left[best] = False
        chosen.append(best)
    return chosen


def _tour(cell: CellDescription, index: int, q: FloatArray, chosen: list[int]) -> list[int]:
    """The chosen poses, each the nearest that is left to the one before."""
    arm = cell.arms[index].arm
    tips = tip_positions(arm, q)
    here, left, order = int(chosen[0]), set(chosen[1:]), [int(chosen[0])]
    while left:
        here = min(left, key=lambda other: float(np.linalg.norm(tips[other] - tips[here])))
        left.remove(here)
        order.append(here)
    return order
