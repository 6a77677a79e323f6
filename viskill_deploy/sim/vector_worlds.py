"""Many worlds of one model in one process: MuJoCo's batch behind the words of `World`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch, SimulationError

from viskill_deploy.core.types import ActiveObject, FloatArray, Scene
from viskill_deploy.sim.vector_scenes import ThingPoses
from viskill_deploy.sim.world import World

IntArray = npt.NDArray[np.intp]


class Worlds:
    """Worlds side by side, each on its own.

    Args:
        world: one of their kind, which lends its model and its knowledge of it.
        count: number of worlds.
        threads: that share their steps; the result does not depend on it.
        robots: a world of every robot, where they are not all of `world`'s.
        of: index of each world's robot, (N,); may change before a reset or restore.

    Attributes:
        world: as given.
        state: MuJoCo's integration state of every world, (N, size).
    """

    def __init__(
        self,
        world: World,
        count: int,
        threads: int = 1,
        robots: Sequence[World] = (),
        of: IntArray | None = None,
    ) -> None:
        self.world = world
        self._robots, self._of = robots, np.zeros(count, dtype=np.intp) if of is None else of
        self._set_to: list[int] = []
        self._batch = Batch(world.model, count, nthread=threads, persistent=True)
        self._poses = ThingPoses(world.model, world.things)
        self._qpos, self._time = self._batch.bind("qpos"), self._batch.bind("time")
        self._joints = world.arm_qpos
        self.state: FloatArray = self._batch.state

    def axes(self, which: IntArray) -> FloatArray:
        """Positions of every arm's six joints and its jaw, (n, arms, 7), rad and m."""
        q = self._qpos[which[:, None, None], self._joints]
        q[..., 6] += q[..., 7]
        axes: FloatArray = q[..., :7]
        return axes

    def poses(self, which: IntArray) -> FloatArray:
        """T_task_object of every thing, (n, things, 4, 4)."""
        return self._poses(self._qpos[which])

    def times(self, which: IntArray) -> FloatArray:
        """Simulated time since the reset, (n,) s."""
        times: FloatArray = self._time[which]
        return times

    def reset(self, scenes: Mapping[int, Scene], axes: Mapping[int, FloatArray]) -> None:
        """`World.reset` of some worlds."""
        rows = []
        self._set_robots()
        for index, scene in scenes.items():
            world = self._robots[self._of[index]] if self._robots else self.world
            world.place(scene, axes.get(index))
            rows.append(world.save())
        which = np.array(list(scenes))
        self._batch.reset(which, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.state[which] = rows
        self._batch.step(which, nstep=self.world.settle_steps)
        self._time[which] = 0.0

    def restore(self, states: Mapping[int, FloatArray]) -> None:
        """`World.restore` of some worlds, whatever they did before."""
        which = np.array(list(states))
        self._set_robots()
        self._batch.reset(which, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.state[which] = list(states.values())
        self._batch.forward(which)
        self.state[which] = list(states.values())

    def run(self, which: IntArray, controls: FloatArray) -> list[int]:
        """Lets control periods pass in some worlds.

        Args:
            which: the worlds, (n,).
            controls: MuJoCo's controls in each period, (n, periods, 2 axes).

        Returns:
            The worlds whose simulation failed.
        """
        rows = np.ascontiguousarray(controls.repeat(self.world.substeps, axis=1))
        warned = self._batch.warning[which].copy()
        failed: set[int] = set()
        try:
            self._batch.rollout(rows.shape[1], rows, record=(), ids=which)
        except SimulationError as error:
            failed.update(int(index) for index in error.ids)
        worse = (self._batch.warning[which] != warned).reshape(len(which), -1).any(axis=1)
        return sorted(failed | set(which[worse].tolist()))

    def _set_robots(self) -> None:
        """Every world runs on the model of its robot."""
        of = self._of.tolist()
        if self._robots and of != self._set_to:
            self._batch.set_models([self._robots[robot].model for robot in of])
            self._set_to = of

    def active_object(self, index: int, active: str, goal: FloatArray) -> ActiveObject:
        """The true state of a world's active object, contacts of the last step."""
        self._batch.get_data(index, self.world.data)
        self.world.attend(active, goal)
        return self.world.active_object()
