"""Hidden robots in many worlds side by side, so that a policy learns to bear what it may meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from viskill_deploy.core.arm_errors import ArmErrors, rotation
from viskill_deploy.core.cables import WRIST
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import FloatArray, Scene
from viskill_deploy.sim.seeing import board_pose
from viskill_deploy.sim.vector_worlds import IntArray
from viskill_deploy.sim.world import World, WorldOptions


class HiddenRobots:
    """Which robot every environment has, and what it does to what is sent and seen.

    Bases, joints and shafts are in the models of the worlds. Here are the wrists' cables and how
    wrongly things are seen. Noise and delay are not drawn: they are the same for all, or off.

    Args:
        cell: the cell.
        options: of the plain worlds.
        robots: one after the other an environment's, and over again.
        count: number of environments.

    Attributes:
        of: each environment's robot, (N,); a saved moment takes its robot along.

    Raises:
        ValueError: a robot differs from the plain worlds by more than what it is.
    """

    def __init__(
        self,
        cell: CellDescription,
        options: WorldOptions,
        robots: Sequence[WorldOptions],
        count: int,
    ) -> None:
        plain = WorldOptions()
        for robot in robots:
            bare = replace(
                robot,
                truth=plain.truth,
                board_translation_m=plain.board_translation_m,
                board_rotation_rad=plain.board_rotation_rad,
                object_error_m=plain.object_error_m,
                object_error_rad=plain.object_error_rad,
            )
            if bare != options:
                raise ValueError(
                    "robots side by side differ in truth, board and how things are seen alone; "
                    "take noise, delay and period out"
                )
        self._cell, self._options = cell, tuple(robots)
        self._worlds: dict[str | None, list[World]] = {}
        self.of: IntArray = np.arange(count) % len(robots)
        arms, things = len(cell.arms), len(World(cell, options).things)
        nothing = (ArmErrors(),) * arms
        cables = [[arm.cables for arm in robot.truth or nothing] for robot in robots]
        self._play = np.array([[arm.backlash_rad for arm in row] for row in cables])
        self._stretch = np.array([[arm.coupling for arm in row] for row in cables])
        self._board = np.array([board_pose(robot) for robot in robots])
        self._spread = np.array([(*r.object_error_m, r.object_error_rad) for r in robots])
        self._wrist: FloatArray = np.zeros((count, arms, 3))
        self._shift: FloatArray = np.zeros((count, arms, 3))
        self._seen: FloatArray = np.zeros((count, things, 4))

    def worlds(self, only: str | None) -> list[World]:
        """A world of every robot, with one free thing or (None) all of them."""
        if only not in self._worlds:
            self._worlds[only] = [World(self._cell, robot, only=only) for robot in self._options]
        return self._worlds[only]

    def begin(self, index: int, scene: Scene, start: FloatArray) -> None:
        """An environment's arms stand still at `start` (arms, 7); its things were put down.

        The same layout on the same robot is always seen with the same errors.
        """
        robot = int(self.of[index])
        self._wrist[index] = start[:, WRIST]
        self._displace(np.array([index]), start[None, :, WRIST])
        places = np.concatenate([thing.T_task_object[:3, 3] for thing in scene.objects])
        dice = np.random.default_rng([robot, *places.view(np.uint32).tolist()])
        self._seen[index] = dice.normal(0.0, 1.0, self._seen[index].shape) * self._spread[robot]

    def felt(self, which: IntArray, rows: FloatArray) -> FloatArray:
        """What the arms feel of controls (n, periods, 2 axes), period by period."""
        told = rows[..., 0::2].reshape(*rows.shape[:2], self._wrist.shape[1], -1)
        felt = told.copy()
        for period in range(told.shape[1]):
            self._displace(which, told[:, period, :, WRIST])
            felt[:, period, :, WRIST] += self._shift[which]
        moved = rows.copy()
        moved[..., 0::2] = felt.reshape(*rows.shape[:2], -1)
        return moved

    def measured(self, axes: FloatArray) -> FloatArray:
        """What encoders say of every environment's axes (N, arms, 7)."""
        reported = axes.copy()
        reported[..., WRIST] -= self._shift
        return reported

    def shown(self, poses: FloatArray) -> FloatArray:
        """Where every environment's things (N, things, 4, 4) are said to be."""
        seen: FloatArray = self._board[self.of][:, None] @ poses
        for index, thing in np.argwhere(self._seen.any(axis=2)).tolist():
            x, y, z, yaw = self._seen[index, thing].tolist()
            seen[index, thing, :3, :3] = rotation((0.0, 0.0, yaw)) @ seen[index, thing, :3, :3]
            seen[index, thing, :3, 3] += (x, y, z)
        return seen

    def save(self, index: int) -> FloatArray:
        """What an environment's robot remembers; `of` goes with it."""
        parts = (self._wrist[index], self._shift[index], self._seen[index])
        return np.concatenate([part.ravel() for part in parts])

    def restore(self, index: int, robot: int, hidden: FloatArray) -> None:
        """An environment goes on as one of that robot that was saved."""
        self.of[index] = robot
        wrist = self._wrist[index].size
        self._wrist[index] = hidden[:wrist].reshape(self._wrist[index].shape)
        self._shift[index] = hidden[wrist : 2 * wrist].reshape(self._shift[index].shape)
        self._seen[index] = hidden[2 * wrist :].reshape(self._seen[index].shape)

    def _displace(self, which: IntArray, told: FloatArray) -> None:
        """Cables after wrists (n, arms, 3) were told to be somewhere; see `Imperfections`."""
        robots = self.of[which]
        play = self._play[robots]
        self._wrist[which] = np.clip(self._wrist[which], told - play, told + play)
        stretch = np.einsum("naij,naj->nai", self._stretch[robots], told)
        self._shift[which] = self._wrist[which] - told + stretch
