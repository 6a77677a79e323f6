"""The physics of many worlds in one thread: MuJoCo's batch behind the words of `World`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch, SimulationError

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import ActiveObject, FloatArray, Scene
from viskill_deploy.sim.vector_scenes import Scenes, ThingPoses
from viskill_deploy.sim.world import World, WorldOptions, controls

IntArray = npt.NDArray[np.intp]


class VectorPhysics:
    """Worlds of one cell, each on its own, which read and move together.

    Args:
        cell: the cell.
        count: number of worlds.
        options: as of `World`; noise has to be off.

    Attributes:
        world: one world of the same kind, which lends its model and its knowledge of it.
        state: MuJoCo's integration state of every world, (N, size).

    Raises:
        ValueError: noise is asked for.
    """

    def __init__(self, cell: CellDescription, count: int, options: WorldOptions) -> None:
        if max(options.joint_noise_rad, options.joint_noise_m, options.object_noise_m) > 0.0:
            raise ValueError("worlds side by side are without noise; set the noises to 0")
        self.world = World(cell, options)
        self._batch = Batch(self.world.model, count, nthread=1, persistent=True)
        self._poses = ThingPoses(self.world.model, self.world.things)
        self._qpos, self._time = self._batch.bind("qpos"), self._batch.bind("time")
        self._joints = self.world.arm_qpos
        self.state: FloatArray = self._batch.state
        size = 2 * self.world.home.size
        self._pending: FloatArray = np.zeros((count, options.delay_periods, size))
        self._active = [self.world.things[0]] * count if self.world.things else [""] * count
        self._goal: FloatArray = np.zeros((count, 3))

    @property
    def axes(self) -> FloatArray:
        """Positions of every arm's six joints and its jaw, (N, arms, 7), rad and m."""
        q = self._qpos[:, self._joints]
        q[..., 6] += q[..., 7]
        axes: FloatArray = q[..., :7]
        return axes

    @property
    def goal(self) -> FloatArray:
        """Where the active objects have to go, (N, 3) m."""
        return self._goal.copy()

    def active(self, index: int) -> str:
        """Name of a world's active object."""
        return self._active[index]

    def pending(self, index: int) -> FloatArray:
        """Controls of a world that are still on their way, (delay periods, 2 axes)."""
        rows: FloatArray = self._pending[index].copy()
        return rows

    def scenes(self) -> Scenes:
        """Where the things are."""
        poses, names = self._poses(self._qpos), self._poses.names
        return Scenes(self._time.copy(), names, poses, tuple(self._active), self.goal)

    def reset(self, scenes: Mapping[int, Scene], axes: Mapping[int, FloatArray]) -> None:
        """`World.reset` of some worlds.

        Raises:
            ViskillError: a scene names an object that the worlds do not have.
        """
        if not scenes:
            return
        rows = []
        for index, scene in scenes.items():
            self.world.place(scene, axes.get(index))
            rows.append(self.world.save())
            self._pending[index] = self.world.data.ctrl
            self.attend(index, scene.active, scene.goal)
        which = np.array(list(scenes))
        self._batch.reset(which, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.state[which] = rows
        self._batch.step(which, nstep=self.world.settle_steps)
        self._time[which] = 0.0

    def restore(self, states: Mapping[int, FloatArray], pending: Mapping[int, FloatArray]) -> None:
        """`World.restore` of some worlds, whatever they did before."""
        if not states:
            return
        which = np.array(list(states))
        self._batch.reset(which, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.state[which] = list(states.values())
        self._pending[which] = [pending[index] for index in states]
        self._batch.forward(which)
        self.state[which] = list(states.values())

    def attend(self, index: int, active: str, goal: FloatArray) -> None:
        """Says which thing of a world counts, and where it has to go."""
        self._active[index], self._goal[index] = active, goal

    def run(self, which: IntArray, positions: FloatArray, velocities: FloatArray) -> list[int]:
        """Lets some worlds pass a segment of the same length.

        Args:
            which: the worlds, (n,).
            positions: axis positions after each period, (periods, n, arms, 7).
            velocities: axis velocities after each period, (periods, n, arms, 7).

        Returns:
            The worlds whose simulation failed.
        """
        sent, periods = controls(positions, velocities).swapaxes(0, 1), len(positions)
        rows = np.concatenate([self._pending[which], sent], axis=1)
        self._pending[which] = rows[:, periods:]
        rows = np.ascontiguousarray(rows[:, :periods].repeat(self.world.substeps, axis=1))
        warned = self._batch.warning[which].copy()
        failed: set[int] = set()
        try:
            self._batch.rollout(rows.shape[1], rows, record=(), ids=which)
        except SimulationError as error:
            failed.update(int(index) for index in error.ids)
        worse = (self._batch.warning[which] != warned).reshape(len(which), -1).any(axis=1)
        return sorted(failed | set(which[worse].tolist()))

    def active_objects(self, which: Sequence[int]) -> list[ActiveObject]:
        """The true state of the active objects of some worlds, contacts of the last step."""
        found = []
        for index in which:
            self._batch.get_data(index, self.world.data)
            self.world.attend(self._active[index], self._goal[index])
            found.append(self.world.active_object())
        return found
