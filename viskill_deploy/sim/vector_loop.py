"""Many episodes of a task side by side, in one thread: `ClosedLoop` for learning.

Each environment runs as `ClosedLoop` would run it alone: the same model, waypoints, segments and
control periods. Environments know nothing of each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.types import FloatArray, Scene, Waypoint
from viskill_deploy.motion.resolve import waypoint_at
from viskill_deploy.motion.vector_paths import Motions
from viskill_deploy.motion.vector_smoothing import Segments, VectorPlanner
from viskill_deploy.motion.vector_waypoints import Waypoints, apply_actions, targets, tips
from viskill_deploy.sim import vector_task
from viskill_deploy.sim.tasks.base import SkillSpec, Task
from viskill_deploy.sim.vector_physics import Moment, VectorPhysics
from viskill_deploy.sim.world import WorldOptions

BoolArray = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class EpisodeState:
    """A moment of an episode, for `VectorLoop.restore`.

    Attributes:
        physics: MuJoCo's integration state.
        motion: commanded positions, velocities and accelerations, (3, arms, 7).
        T_task_tip: tips of the waypoint commanded last, (arms, 4, 4).
        jaw: its jaws, (arms,) rad.
        pending: controls that are still on their way, (delay periods, 2 axes).
        aside: poses of things that are not simulated, (things, 4, 4); the others' mean nothing.
        active: name of the object to manipulate.
        goal: where it has to go, task frame, (3,) m.
        flags: the task's contact flags, (k,).
        robot: index of the hidden robot that it is of; 0 where there are none.
        hidden: what that robot remembers.
    """

    physics: FloatArray
    motion: FloatArray
    T_task_tip: FloatArray
    jaw: FloatArray
    pending: FloatArray
    aside: FloatArray
    active: str
    goal: FloatArray
    flags: FloatArray
    robot: int = 0
    hidden: FloatArray = field(default_factory=lambda: np.zeros(0))


class VectorLoop:
    """Episodes of a task side by side.

    Args:
        task: what to do.
        count: number of environments.
        options: of their worlds; noise has to be off. Perfect ones at 4 ms by default.
        bystanders: whether their worlds hold the free things that are not to be moved; quicker and
            the same without, as long as nothing would have touched them (see `VectorPhysics`).
        threads: of physics; the result does not depend on it.
        robots: hidden robots (truth, board and how things are seen), one after the other an
            environment's; () for arms as the cell's files say.

    Attributes:
        task, count: as given.
        alive: which environments run, (count,). None does before its first reset; one whose action
            could not be followed stands still until it is reset or restored.
        stretch: how much longer than meant each one's last step took, (count,).
    """

    def __init__(
        self,
        task: Task,
        count: int,
        options: WorldOptions | None = None,
        bystanders: bool = True,
        threads: int = 1,
        robots: Sequence[WorldOptions] = (),
    ) -> None:
        self.task, self.count = task, count
        self._physics = VectorPhysics(
            task.cell, count, options or WorldOptions(), bystanders, threads, robots
        )
        self._period_s = self._physics.world.options.period_s
        self._planner = VectorPlanner(task.cell, self._period_s)
        home = self._physics.world.home
        self._motion = Motions.at_rest(np.repeat(home[None], count, axis=0))
        self._last = Waypoints(
            np.repeat(np.eye(4)[None], count * len(home), axis=0).reshape(count, -1, 4, 4),
            np.zeros((count, len(home))),
        )
        self.alive: BoolArray = np.zeros(count, dtype=bool)
        self.stretch: FloatArray = np.ones(count)
        self._tips: FloatArray | None = None
        self._flags: dict[int, FloatArray] = {}

    def reset(
        self, scenes: Mapping[int, Scene], axes: Mapping[int, FloatArray] | None = None
    ) -> None:
        """New episodes in some environments.

        Args:
            scenes: where the objects are, by environment.
            axes: axis positions of the arms, (arms, 7), by environment; the cell's start pose by
                default.

        Raises:
            ViskillError: a scene names an object that the world does not have.
        """
        axes = axes or {}
        self._physics.reset(scenes, axes)
        for index in scenes:
            start = axes.get(index, self._physics.world.home)
            waypoint = waypoint_at(self.task.cell, start)
            motion = np.stack([start, np.zeros_like(start), np.zeros_like(start)])
            self._begin(index, motion, np.array(waypoint.T_task_tip), np.array(waypoint.jaw))
            self._flags.pop(index, None)

    def restore(self, states: Mapping[int, EpisodeState]) -> None:
        """Goes on from saved moments in some environments.

        Things that slept when the moment was saved are awake for ten physics steps, in which they
        may creep by less than 0.1 um. All else goes on as it would have.
        """
        self._physics.restore(
            {i: _moment(state) for i, state in states.items()},
            {i: (state.active, state.goal) for i, state in states.items()},
        )
        for index, state in states.items():
            self._begin(index, state.motion, state.T_task_tip, state.jaw)
            self._flags[index] = state.flags

    def _begin(self, index: int, motion: FloatArray, tips: FloatArray, jaw: FloatArray) -> None:
        self._motion.p[index], self._motion.v[index], self._motion.a[index] = motion
        self._last.T_task_tip[index], self._last.jaw[index] = tips, jaw
        self.alive[index], self.stretch[index] = True, 1.0
        self._tips = None

    def save(self, index: int) -> EpisodeState:
        """The present moment of an environment."""
        motion, moment = self._motion, self._physics.save(index)
        active, goal = self._physics.active(index)
        return EpisodeState(
            moment.physics,
            np.stack([motion.p[index], motion.v[index], motion.a[index]]),
            self._last.T_task_tip[index].copy(),
            self._last.jaw[index].copy(),
            moment.pending,
            moment.aside,
            active,
            goal,
            self._flags_of(index),
            moment.robot,
            moment.hidden,
        )

    def observe(self) -> FloatArray:
        """What policies see now, (count, n)."""
        jaws = self._physics.axes()[..., 6]
        return vector_task.observe(self.task, self._measured(), jaws, self._physics.scenes())

    def step(self, actions: FloatArray, skills: Sequence[SkillSpec]) -> BoolArray:
        """Lets one policy step pass in every environment that is alive.

        Args:
            actions: (count, 5 * arms); those of dead environments do not count.
            skills: the skill that acts in each environment; it does not change the motion, the gate
                is what reads its rights.

        Returns:
            Which environments are alive, (count,). One dies by an action that is not finite, asks
            for a waypoint out of reach or for a motion that no limits allow, or makes the
            simulation fail.
        """
        if len(skills) != self.count:
            raise ValueError(f"{len(skills)} skills for {self.count} environments; give one each")
        self.alive &= np.isfinite(actions).all(axis=1)
        run = np.flatnonzero(self.alive)
        if not len(run):
            return self.alive.copy()
        last = Waypoints(self._last.T_task_tip[run], self._last.jaw[run])
        asked = apply_actions(
            last, actions[run], self._measured()[run], self.task.cell, self.task.action
        )
        motion = self._motion.rows(run)
        goal, reached = targets(self.task.cell, asked, motion.p)
        goal = np.where(reached[:, None, None], goal, motion.p)
        step_s = self.task.cell.file.motion.step_s
        wish = (goal - motion.p) / step_s
        wish[..., 6] = 0.0
        segments = self._planner.plan(motion, goal, wish, step_s)
        ok = reached & segments.planned
        moved = run[ok]
        self._last.T_task_tip[moved], self._last.jaw[moved] = asked.T_task_tip[ok], asked.jaw[ok]
        self._run(run, segments, ok)
        self.alive[run[~ok]] = False
        return self.alive.copy()

    def _run(self, run: npt.NDArray[np.intp], segments: Segments, ok: BoolArray) -> None:
        """Lets the segments pass, environments with segments of one length together."""
        for periods in np.unique(segments.periods[ok]).tolist():
            rows = np.flatnonzero(ok & (segments.periods == periods))
            times = np.arange(1, periods + 1) * self._period_s
            table = segments.paths.rows(rows).sampled(times)
            self.alive[self._physics.run(run[rows], *table)] = False
        end, moved = segments.paths.end(), run[ok]
        self._motion.p[moved] = end.p[ok]
        self._motion.v[moved] = end.v[ok]
        self._motion.a[moved] = end.a[ok]
        self.stretch[moved] = segments.stretch[ok]
        self._tips = None
        for index in moved.tolist():
            self._flags.pop(index, None)

    def flags(self) -> FloatArray:
        """The contacts that the task's subgoals speak of, as 0 or 1, (count, k)."""
        return np.array([self._flags_of(index) for index in range(self.count)])

    def _flags_of(self, index: int) -> FloatArray:
        if index not in self._flags:
            (thing,) = self._physics.active_objects([index])
            self._flags[index] = np.array(self.task.flags(thing), dtype=np.float64)
        return self._flags[index]

    def success(self) -> BoolArray:
        """Whether the whole task is done now, (count,)."""
        things = self._physics.active_objects(range(self.count))
        pairs = zip(things, self.scenes(), strict=True)
        return np.array([self.task.success(thing, scene) for thing, scene in pairs])

    def scenes(self) -> tuple[Scene, ...]:
        """Where the objects are in every environment."""
        scenes = self._physics.scenes()
        return tuple(scenes.row(index) for index in range(self.count))

    def goals(self) -> FloatArray:
        """Where the active objects have to go, (count, 3) m."""
        return self._physics.goals()

    def waypoint(self, index: int) -> Waypoint:
        """The waypoint commanded last in an environment."""
        return self._last.row(index, self.task.cell.file.motion.step_s)

    def _measured(self) -> FloatArray:
        """T_task_tip of every arm as measured, (count, arms, 4, 4)."""
        if self._tips is None:
            self._tips = tips(self.task.cell, self._physics.axes()[..., :6])
        return self._tips


def _moment(state: EpisodeState) -> Moment:
    """What the physics keeps of a moment."""
    return Moment(state.physics, state.pending, state.aside, state.robot, state.hidden)
