"""The physics of many environments in one thread, whatever things they hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import ViskillError
from viskill_deploy.core.types import ActiveObject, FloatArray, Scene
from viskill_deploy.sim.vector_robots import HiddenRobots
from viskill_deploy.sim.vector_scenes import Scenes, ThingPoses
from viskill_deploy.sim.vector_worlds import IntArray, Worlds
from viskill_deploy.sim.world import World, WorldOptions, controls

V = TypeVar("V")
EVERYTHING = ""
"""Kind of the worlds that hold every thing; others are called after their active object."""


@dataclass(frozen=True, slots=True)
class Moment:
    """A moment of one world.

    Attributes:
        physics: MuJoCo's integration state.
        pending: controls that are on their way, (delay periods, 2 axes).
        aside: poses of things that are not simulated, (things, 4, 4).
        robot: index of its hidden robot; 0 where there are none.
        hidden: what that robot remembers.
    """

    physics: FloatArray
    pending: FloatArray
    aside: FloatArray
    robot: int
    hidden: FloatArray


class VectorPhysics:
    """Worlds of one cell, each on its own, which read and move together.

    Args:
        cell: the cell.
        count: number of worlds.
        options: as of `World`; noise has to be off.
        bystanders: whether a world holds the free things that are not its active object. Without
            them a step is up to twice as quick and the same to the last bit, as long as nothing
            would have touched one; they are then seen where the scene of the reset had put them.
        threads: of physics.
        robots: hidden robots, one after the other an environment's; () for none.

    Attributes:
        world: a world that holds everything.

    Raises:
        ValueError: noise is asked for.
    """

    def __init__(
        self,
        cell: CellDescription,
        count: int,
        options: WorldOptions,
        bystanders: bool = True,
        threads: int = 1,
        robots: Sequence[WorldOptions] = (),
    ) -> None:
        if not options.is_plain:
            raise ValueError(
                "worlds side by side are without noise, errors, lag and losses; set those to 0"
            )
        self.world, self.count, self._bystanders = World(cell, options), count, bystanders
        self._threads = threads
        self._hidden = HiddenRobots(cell, options, robots, count) if robots else None
        self._groups: dict[str, Worlds] = {}
        if bystanders:
            self._groups[EVERYTHING] = self._side_by_side(self.world, None)
        self._active = [(*self.world.things, "")[0]] * count
        self._started: npt.NDArray[np.bool_] = np.zeros(count, dtype=bool)
        self._goal: FloatArray = np.zeros((count, 3))
        size = 2 * self.world.home.size
        self._pending: FloatArray = np.zeros((count, options.delay_periods, size))
        parked = ThingPoses(self.world.model, self.world.things)(self.world.model.qpos0[None])
        self._parked: FloatArray = parked[0]
        self._aside: FloatArray = parked.repeat(count, axis=0)
        self._members: dict[str, IntArray] | None = None

    def axes(self) -> FloatArray:
        """Positions of every arm's six joints and its jaw, (N, arms, 7), rad and m."""
        axes = np.repeat(self.world.home[None], self.count, axis=0)
        for worlds, which in self._running():
            axes[which] = worlds.axes(which)
        return axes if self._hidden is None else self._hidden.measured(axes)

    def goals(self) -> FloatArray:
        """Where the active objects have to go, (N, 3) m."""
        return self._goal.copy()

    def scenes(self) -> Scenes:
        """Where the things are."""
        names, poses, times = self.world.things, self._aside.copy(), np.zeros(self.count)
        for worlds, which in self._running():
            columns = [names.index(name) for name in worlds.world.things]
            poses[which[:, None], columns] = worlds.poses(which)
            times[which] = worlds.times(which)
        if self._hidden is not None:
            poses = self._hidden.shown(poses)
        return Scenes(times, names, poses, tuple(self._active), self.goals())

    def reset(self, scenes: Mapping[int, Scene], axes: Mapping[int, FloatArray]) -> None:
        """`World.reset` of some worlds.

        Raises:
            ViskillError: a scene names an object that the worlds do not have.
        """
        for index, scene in scenes.items():
            self._check(scene)
            self._attend(index, scene.active, scene.goal)
            self._aside[index] = self._parked
            for thing in scene.objects:
                self._aside[index, self.world.things.index(thing.name)] = thing.T_task_object
            start = axes.get(index, self.world.home)
            self._pending[index] = controls(start, np.zeros_like(start))
            if self._hidden is not None:
                self._hidden.begin(index, scene, start)
        for worlds, mine in self._by_kind(scenes):
            names = worlds.world.things
            worlds.reset({index: _with_only(scene, names) for index, scene in mine}, axes)

    def save(self, index: int) -> Moment:
        """The present moment of a world."""
        state = self._group(self._kind(index)).state[index]
        hidden = self._hidden
        return Moment(
            state.copy(),
            self._pending[index].copy(),
            self._aside[index].copy(),
            0 if hidden is None else int(hidden.of[index]),
            np.zeros(0) if hidden is None else hidden.save(index),
        )

    def active(self, index: int) -> tuple[str, FloatArray]:
        """Name of a world's active object, and where it has to go."""
        return self._active[index], self._goal[index].copy()

    def restore(
        self,
        saved: Mapping[int, Moment],
        active: Mapping[int, tuple[str, FloatArray]],
    ) -> None:
        """`World.restore` of some worlds, whatever they did before, from `save` and `active`."""
        for index, moment in saved.items():
            self._attend(index, *active[index])
            self._pending[index], self._aside[index] = moment.pending, moment.aside
            if self._hidden is not None:
                self._hidden.restore(index, moment.robot, moment.hidden)
        for worlds, mine in self._by_kind(saved):
            worlds.restore({index: moment.physics for index, moment in mine})

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
        arrived, failed = rows[:, :periods], list[int]()
        if self._hidden is not None:
            arrived = self._hidden.felt(which, arrived)
        for worlds, members in self._running():
            mine = np.isin(which, members)
            if mine.any():
                failed += worlds.run(which[mine], arrived[mine])
        return failed

    def active_objects(self, which: Sequence[int]) -> list[ActiveObject]:
        """The true state of the active objects of some worlds, contacts of the last step."""
        return [
            self._group(self._kind(index)).active_object(
                index, self._active[index], self._goal[index]
            )
            for index in which
        ]

    def _check(self, scene: Scene) -> None:
        for name in (scene.active, *(thing.name for thing in scene.objects)):
            if name not in self.world.things:
                known = ", ".join(self.world.things) or "none"
                raise ViskillError(f"no object {name!r} in this world; it has: {known}")

    def _attend(self, index: int, active: str, goal: FloatArray) -> None:
        self._active[index], self._goal[index], self._started[index] = active, goal, True
        self._members = None

    def _kind(self, index: int) -> str:
        return EVERYTHING if self._bystanders else self._active[index]

    def _group(self, kind: str) -> Worlds:
        """The worlds of a kind, made when the first of them is needed."""
        if kind not in self._groups:
            world = World(self.world.cell, self.world.options, only=kind)
            self._groups[kind] = self._side_by_side(world, kind)
        return self._groups[kind]

    def _side_by_side(self, world: World, only: str | None) -> Worlds:
        if self._hidden is None:
            return Worlds(world, self.count, self._threads)
        robots = self._hidden.worlds(only)
        return Worlds(world, self.count, self._threads, robots, self._hidden.of)

    def _running(self) -> list[tuple[Worlds, IntArray]]:
        """Every kind's worlds, and which of them are in use."""
        if self._members is None:
            kinds = np.array([self._kind(index) for index in range(self.count)])
            used = dict.fromkeys(kinds[self._started].tolist())
            self._members = {kind: np.flatnonzero(self._started & (kinds == kind)) for kind in used}
        return [(self._group(kind), which) for kind, which in self._members.items()]

    def _by_kind(self, values: Mapping[int, V]) -> list[tuple[Worlds, list[tuple[int, V]]]]:
        """Values by environment, those of one kind together."""
        sorted_: dict[str, list[tuple[int, V]]] = {}
        for index, value in values.items():
            sorted_.setdefault(self._kind(index), []).append((index, value))
        return [(self._group(kind), mine) for kind, mine in sorted_.items()]


def _with_only(scene: Scene, names: Sequence[str]) -> Scene:
    """A scene without the things that have other names."""
    objects = tuple(thing for thing in scene.objects if thing.name in names)
    return Scene(scene.stamp_s, objects, scene.active, scene.goal)
