"""Points of a cell that have a name, a known place, and can be touched with the end of a jaw."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from viskill_deploy.calibrate.measurements import Measurements
from viskill_deploy.calibrate.programme import LIMIT_MARGIN, most_telling
from viskill_deploy.core.arm_errors import rotation
from viskill_deploy.core.cell_files import Board, Panel, Wall
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.kinematics.closed_form import inverse_batch
from viskill_deploy.motion.resolve import base_poses
from viskill_deploy.motion.waypoints import start_waypoint

FEWEST_TOUCHES = 8
"""Touches of an arm below which base, joint 3 and the wrist's zeros are not told apart."""

TRIES = 40
"""Tilts at which a point is tried to be reached."""

TILT_RAD, TURN_RAD = 0.45, 0.8
"""How far a tool is tilted and turned away from the cell's start pose at a touch: a person can do
that beside pegs, and tools that are always held alike say nothing about the wrist."""

CORNERS = 3
"""Of a block: it looks triangular from above."""


@dataclass(frozen=True)
class Landmark:
    """A point with a name.

    Attributes:
        name: such as "peg3".
        position: in the frame of the board (the task frame) or of the thing, (3,) m.
        thing: what it is a point of; "" for what stands in the cell's file.
    """

    name: str
    position: FloatArray
    thing: str = ""

    def __str__(self) -> str:
        if self.thing:
            return f"{self.name}, a corner of its top; each once, in any order"
        x, y, z = (1e3 * self.position).tolist()
        return f"{self.name} (x {x:.1f}, y {y:.1f}, z {z:.1f} mm)"


def board_landmarks(cell: CellDescription) -> tuple[Landmark, ...]:
    """The points of what stands in the cell, task frame.

    Board: corners of its top, and the middle of every peg's top. Wall: the middle of every peg's
    end. Panel: corners of its plates.

    Raises:
        CalibrationError: the cell's file has neither of them.
    """
    file, found = cell.file, list[Landmark]()
    if file.board is not None:
        found += _of_board(file.board)
    if file.wall is not None:
        found += _of_wall(file.wall)
    if file.panel is not None:
        found += _of_panel(file.panel)
    if not found:
        raise CalibrationError(
            f"{cell.files[0]} has no [board], [wall] or [panel], so no point to touch has a known "
            "place; add one of them"
        )
    return tuple(found)


def block_landmarks(cell: CellDescription, thing: str = "block0") -> tuple[Landmark, ...]:
    """The corners of a block's top, in the block's frame.

    Raises:
        CalibrationError: the cell's file has no block.
    """
    block = cell.file.block
    if block is None:
        raise CalibrationError(
            f"{cell.files[0]} has no [block]; measure where its things are with a tracker "
            "(--pose-topic), or name a file of poses (--poses)"
        )
    angles = 2.0 * np.pi * np.arange(CORNERS) / CORNERS
    return tuple(
        Landmark(
            f"{thing}/corner{i}",
            np.array([*(block.corner_radius_m * np.array([c, s])), block.height_m / 2.0]),
            thing,
        )
        for i, (c, s) in enumerate(zip(np.cos(angles), np.sin(angles), strict=True))
    )


def postures(cell: CellDescription, index: int, point: FloatArray, seed: int = 0) -> FloatArray:
    """Joints at which an arm has the end of its closed jaw at a point, tilted in many ways.

    Args:
        cell: where the arm stands.
        index: of the arm.
        point: task frame, (3,) m.
        seed: of the tilts.

    Returns:
        (k, 6), inside the joint limits and past the cannula; (0, 6) for a point out of reach.
    """
    arm, start = cell.arms[index], start_waypoint(cell).T_task_tip[index]
    rng = np.random.default_rng([seed, index])
    poses = np.tile(np.eye(4), (TRIES, 1, 1))
    tilts = rng.uniform(-TILT_RAD, TILT_RAD, (TRIES, 2))
    turns = rng.uniform(-TURN_RAD, TURN_RAD, TRIES)
    for pose, (a, b), turn in zip(poses, tilts, turns, strict=True):
        pose[:3, :3] = rotation((a, b, turn)) @ start[:3, :3]
        pose[:3, 3] = point - arm.arm.jaw.finger_length_m * pose[:3, 2]
    home = inverse_batch(arm.arm, base_poses(cell, index, start[None]), np.zeros(6))[0]
    q, reached = inverse_batch(arm.arm, base_poses(cell, index, poses), home[0])
    lower, upper = np.array(arm.arm.limit(0)), np.array(arm.arm.limit(1))
    room = LIMIT_MARGIN * (upper - lower)
    inside = reached & (q >= lower + room).all(axis=1) & (q <= upper - room).all(axis=1)
    inside &= q[:, 2] >= arm.arm.insertion_min_m
    return np.asarray(q[inside])


def choose_landmarks(
    cell: CellDescription, index: int, landmarks: Sequence[Landmark], count: int
) -> tuple[Landmark, ...]:
    """The points that an arm shall touch, those first that tell most.

    Raises:
        CalibrationError: fewer can be reached, or the arm's joints are not a PSM's.
    """
    arm = cell.arms[index]
    if not arm.arm.has_remote_centre:
        raise CalibrationError(
            f"{arm.name} is no PSM; its errors cannot be fitted, only its port registered"
        )
    ways = [(mark, postures(cell, index, mark.position)) for mark in landmarks]
    near = [(mark, q[0]) for mark, q in ways if len(q)]
    if len(near) < count:
        raise CalibrationError(
            f"{arm.name} reaches {len(near)} of the cell's {len(landmarks)} named points "
            f"({', '.join(mark.name for mark, _ in near)}), not {count}; ask for fewer points"
        )
    n = len(near)
    rows = Measurements(
        np.arange(float(n)),
        np.array([q for _, q in near]),
        np.zeros((n, 6)),
        np.zeros((n, 3)),
        np.array([mark.position for mark, _ in near]),
        arm.arm.jaw.finger_length_m,
    )
    return tuple(near[i][0] for i in most_telling(arm, rows, count))


def _of_board(board: Board) -> list[Landmark]:
    half_x, half_y = board.size_m[0] / 2.0, board.size_m[1] / 2.0
    corners = itertools.product((half_x, -half_x), (half_y, -half_y))
    found = [Landmark(f"corner{i}", np.array([x, y, 0.0])) for i, (x, y) in enumerate(corners)]
    height = board.peg_height_m
    pegs = enumerate(board.peg_xy_m)
    return found + [Landmark(f"peg{i}", np.array([x, y, height])) for i, (x, y) in pegs]


def _of_wall(wall: Wall) -> list[Landmark]:
    end = wall.front_x_m + wall.peg_length_m
    pegs = enumerate(wall.peg_yz_m)
    return [Landmark(f"wall_peg{i}", np.array([end, y, z])) for i, (y, z) in pegs]


def _of_panel(panel: Panel) -> list[Landmark]:
    lines = panel.pitch_m * (np.arange(4) - 1.5)
    corners = enumerate(itertools.product(lines, lines))
    return [Landmark(f"plate{i}", np.array([x, y, panel.plate_top_m])) for i, (x, y) in corners]
