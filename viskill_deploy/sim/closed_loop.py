"""One world driven by a policy's actions exactly as the runtime drives it.

The state is read at the end of each segment; the action makes the next waypoint; the segment starts
from the present commanded motion and ends with the speed of the displacement. A policy that is
trained here meets the same steps when it is deployed.
"""

from __future__ import annotations

import numpy as np

from viskill_deploy.core.types import FloatArray, Scene, Waypoint
from viskill_deploy.motion.links import CellLinks
from viskill_deploy.motion.resolve import waypoint_at
from viskill_deploy.motion.smoothing import AxisMotion, Segment, SegmentPlanner, passing_velocity
from viskill_deploy.motion.waypoints import ActionSpec, apply_action
from viskill_deploy.sim.tasks.base import SkillSpec, Task
from viskill_deploy.sim.world import World


class ClosedLoop:
    """An episode of a task.

    Args:
        task: what to do.
        world: where; a perfect one at 4 ms by default.
        action: what actions mean; the task's own meaning by default.

    Attributes:
        stretch: how much longer than meant the last step took.
    """

    def __init__(
        self, task: Task, world: World | None = None, action: ActionSpec | None = None
    ) -> None:
        self.task, self.world = task, world or World(task.cell)
        self._action = action or task.action
        self._planner = SegmentPlanner(task.cell, self.world.options.period_s)
        self._links = CellLinks(task.cell)
        self._rest(self.world.home)

    def _rest(self, axes: FloatArray) -> None:
        self._motion: tuple[AxisMotion, ...] = tuple(
            AxisMotion.at_rest(row) for row in axes.tolist()
        )
        self._last = waypoint_at(self.task.cell, axes)
        self.stretch = 1.0

    @property
    def waypoint(self) -> Waypoint:
        """The waypoint commanded last."""
        return self._last

    def reset(
        self,
        scene: Scene,
        axes: FloatArray | None = None,
        setpoints: FloatArray | None = None,
    ) -> FloatArray:
        """A new episode; returns the first observation.

        Args:
            scene: where the objects are.
            axes: axis positions of the arms, (arms, 7); the cell's start pose by default.
            setpoints: what the arms are told to hold, (arms, 7); where they are by default.
        """
        self.world.reset(scene, axes, setpoints)
        self._rest(next(x for x in (setpoints, axes, self.world.home) if x is not None))
        return self.observe()

    def observe(self) -> FloatArray:
        """What the policy sees now."""
        readings = [self.world.measured(index) for index in range(len(self._links.arms))]
        self._tips = self._links.tips([reading.jp for reading in readings])
        jaws = [reading.jaw for reading in readings]
        return self.task.observe(self._tips, jaws, self.world.scene())

    def plan(self, action: FloatArray, skill: SkillSpec) -> Segment:
        """The segment that an action asks for, seen from the last observation.

        Raises:
            NoSolutionError: the waypoint is out of reach.
            MotionError: no motion inside the limits does what the action asks for.
        """
        cell = self.task.cell
        self._last = apply_action(
            self._last, action, self._tips, cell, self._action, skill.name, skill.may_open_jaw
        )
        target = self._links.targets(self._last, self._motion)
        wish = passing_velocity(self._motion, np.array(target), self._last.step_s)
        return self._planner.plan(self._motion, target, wish, self._last.step_s)

    def step(self, action: FloatArray, skill: SkillSpec) -> FloatArray:
        """Lets one policy step pass; returns the next observation.

        Raises:
            NoSolutionError: the waypoint is out of reach.
            MotionError: no motion inside the limits does what the action asks for.
        """
        segment = self.plan(action, skill)
        self.world.run(*segment.table(self.world.options.period_s))
        self._motion, self.stretch = segment.at(segment.duration_s), segment.stretch
        return self.observe()

    def flags(self) -> tuple[bool, ...]:
        """The contacts that the task's subgoals speak of."""
        return self.task.flags(self.world.active_object())

    def success(self) -> bool:
        """Whether the task is done now."""
        return self.task.success(self.world.active_object(), self.world.scene())
