"""What somebody who looks at a world says of places in it: on a hidden robot, not the whole truth.

A world's own frame is that of its board. Arms and trackers speak of the task frame, which is where
people believe the board's to be; `WorldOptions` say how far that is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from viskill_deploy.core.arm_errors import rotation
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.imperfections import WorldOptions


def board_pose(options: WorldOptions) -> FloatArray:
    """Where the board really is in the task frame, (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation(options.board_rotation_rad), options.board_translation_m
    return pose


def seen_from_board(cell: CellDescription, options: WorldOptions) -> CellDescription:
    """The cell with its bases in the board's own frame instead of the task frame."""
    T_board_task = np.linalg.inv(board_pose(options))
    if np.array_equal(T_board_task, np.eye(4)):
        return cell
    arms = tuple(replace(arm, T_task_base=T_board_task @ arm.T_task_base) for arm in cell.arms)
    return replace(cell, arms=arms)


class Seeing:
    """Says where things and tips are, task frame.

    Args:
        options: of the world.
        seed: of what is drawn.
    """

    def __init__(self, options: WorldOptions, seed: int) -> None:
        self._T_task_board = board_pose(options)
        self._has_board = not np.array_equal(self._T_task_board, np.eye(4))
        self._spread = np.array([*options.object_error_m, options.object_error_rad])
        self._dice = np.random.default_rng([seed, 5])
        self._errors: dict[str, FloatArray] = {}

    def put_down(self, names: Sequence[str]) -> None:
        """Things were put elsewhere: how wrongly each is seen is drawn anew."""
        if self._spread.any():
            self._errors = {name: self._dice.normal(0.0, 1.0, 4) * self._spread for name in names}

    def error(self, name: str) -> FloatArray:
        """How far from its place a thing is seen, and by what it seems turned, (4,) m and rad."""
        return self._errors.get(name, np.zeros(4)).copy()

    def thing(self, name: str, pose: FloatArray) -> FloatArray:
        """Where a thing at `pose` (4, 4) in the board's frame is said to be."""
        if self._has_board:
            pose = self._T_task_board @ pose
        if name in self._errors:
            x, y, z, yaw = self._errors[name].tolist()
            pose[:3, :3] = rotation((0.0, 0.0, yaw)) @ pose[:3, :3]
            pose[:3, 3] += (x, y, z)
        return pose

    def points(self, points: FloatArray) -> FloatArray:
        """Where points (n, 3) of the board's frame are."""
        T = self._T_task_board
        return np.asarray(points @ T[:3, :3].T + T[:3, 3]) if self._has_board else points
