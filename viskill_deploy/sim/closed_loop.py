"""One world driven by a policy's actions exactly as the runtime drives it.

The state is read at the end of each segment; the action makes the next waypoint; the segment starts
from the present commanded motion and ends with the speed of the displacement. A policy that is
trained here meets the same steps when it is deployed.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from viskill_deploy.core.types import FloatArray, Scene
from viskill_deploy.motion.resolve import resolve, task_poses
from viskill_deploy.motion.smoothing import AxisMotion, Segment, SegmentPlanner
from viskill_deploy.motion.waypoints import apply_action, start_waypoint
from viskill_deploy.sim.tasks.base import SkillSpec, Task
from viskill_deploy.sim.world import World


def passing_velocity(
    start: Sequence[AxisMotion], target: FloatArray, step_s: float
) -> list[list[float]]:
    """Axis velocities wished at a waypoint: displacement over step, jaw at rest; (7,) an arm."""
    rows = []
    for motion, goal in zip(start, target, strict=True):
        v = ((goal - np.array(motion.p)) / step_s).tolist()
        v[6] = 0.0
        rows.append(v)
    return rows


class ClosedLoop:
    """An episode of a task.

    Args:
        task: what to do.
        world: where; a perfect one at 4 ms by default.

    Attributes:
        stretch: how much longer than meant the last step took.
    """

    def __init__(self, task: Task, world: World | None = None) -> None:
        self.task, self.world = task, world or World(task.cell)
        self._planner = SegmentPlanner(task.cell, self.world.options.period_s)
        self._rest(self.world.home)

    def _rest(self, axes: FloatArray) -> None:
        self._motion: tuple[AxisMotion, ...] = tuple(
            AxisMotion.at_rest(row) for row in axes.tolist()
        )
        self._last = start_waypoint(self.task.cell, self.task.action)
        self.stretch = 1.0

    def reset(self, scene: Scene) -> FloatArray:
        """A new episode from the cell's start pose; returns the first observation."""
        self.world.reset(scene)
        self._rest(self.world.home)
        return self.observe()

    def observe(self) -> FloatArray:
        """What the policy sees now."""
        poses, jaws = self._measured()
        return self.task.observe(poses, jaws, self.world.scene())

    def plan(self, action: FloatArray, skill: SkillSpec) -> Segment:
        """The segment that an action asks for; the episode's next step."""
        poses, _ = self._measured()
        cell = self.task.cell
        self._last = apply_action(
            self._last, action, poses, cell, self.task.action, skill.name, skill.may_open_jaw
        )
        target = resolve(cell, [self._last], [m.p for m in self._motion])[1]
        wish = passing_velocity(self._motion, target, self._last.step_s)
        return self._planner.plan(self._motion, target.tolist(), wish, self._last.step_s)

    def step(self, action: FloatArray, skill: SkillSpec) -> FloatArray:
        """Lets one policy step pass; returns the next observation.

        Raises:
            MotionError: no motion inside the limits does what the action asks for.
        """
        segment = self.plan(action, skill)
        self.world.run(*segment.table(self.world.options.period_s))
        self._motion, self.stretch = segment.at(segment.duration_s), segment.stretch
        return self.observe()

    def touched(self) -> tuple[bool, ...]:
        """Per arm, whether it touches the active object."""
        return self.world.active_object().touched

    def success(self) -> bool:
        """Whether the task is done now."""
        return self.task.success(self.world.active_object(), self.world.scene())

    def _measured(self) -> tuple[list[FloatArray], list[float]]:
        poses, jaws = [], []
        for index in range(len(self.task.cell.arms)):
            reading = self.world.measured(index)
            poses.append(task_poses(self.task.cell, index, np.array([reading.jp]))[0])
            jaws.append(reading.jaw)
        return poses, jaws
