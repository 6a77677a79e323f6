"""Who tells a skill what to reach: the task's scripted plan, or the bundle's chaining policy."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

import numpy as np

from viskill_deploy.bundle.format import CHOSEN_SIZE, Bundle
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import MotionError
from viskill_deploy.core.types import FloatArray, Scene, SkillStart
from viskill_deploy.sim.tasks.base import Task

FAR_OUTSIDE_M = 0.02
"""How far a chosen position may lie outside the box around all arms' workspaces.

No arm can leave its workspace: waypoints are held inside and the gate refuses the rest. A skill
that is told to reach a point a few millimetres outside stops at the wall, near enough. A point two
policy steps outside is no inaccurate choice but a wrong one (another frame, scaled units, a state
that training never showed), and no arm shall set out for it.
"""


class SubgoalSource(Protocol):
    """Gives a skill's subgoal at its first step."""

    def __call__(self, skill: str, observation: FloatArray, scene: Scene) -> SkillStart:
        """The subgoal, from what is seen at the skill's start.

        Raises:
            BundleError: a graph cannot run.
            MotionError: what was chosen is no subgoal.
        """
        ...


def subgoal_source(bundle: Bundle, task: Task, rng: np.random.Generator) -> SubgoalSource:
    """What the bundle's manifest asks for.

    Args:
        bundle: a loaded bundle.
        task: its task.
        rng: for the scripted plan; a chaining policy does not use it.
    """
    if bundle.manifest.subgoals == "chaining":
        return ChosenSubgoals(bundle, task)
    return ScriptedSubgoals(task, rng)


class ScriptedSubgoals:
    """The task's scripted plan, made once, from the first observation of the episode."""

    def __init__(self, task: Task, rng: np.random.Generator) -> None:
        self._task, self._rng = task, rng
        self._plan: dict[str, FloatArray] = {}

    def __call__(self, skill: str, observation: FloatArray, scene: Scene) -> SkillStart:
        """The plan's subgoal for a skill."""
        if not self._plan:
            self._plan = self._task.subgoals(observation, scene, self._rng)
        return SkillStart(skill, self._plan[skill], "scripted")


class ChosenSubgoals:
    """The chaining policy: each skill's subgoal from what is seen at its start, the last's given.

    It knows the observation and the goal alone, so it works where only a tracker says where things
    are.
    """

    def __init__(self, bundle: Bundle, task: Task) -> None:
        self._bundle, self._task = bundle, task
        self._last = bundle.manifest.skills[-1].name

    def __call__(self, skill: str, observation: FloatArray, scene: Scene) -> SkillStart:
        """The subgoal that the skill's graph chooses, completed by the task."""
        if skill == self._last:
            goal = self._task.final_subgoal(observation, scene)
            return SkillStart(skill, goal, "task")
        chosen = self._bundle.chaining[skill](observation, scene.goal)
        if not np.isfinite(chosen).all():
            raise MotionError(
                f"the subgoal chosen for {skill!r} is not finite; look at the observation, or "
                "train the chaining policy again"
            )
        goal = self._task.complete_subgoal(skill, chosen, observation, scene)
        check_reachable(skill, goal, self._task.cell)
        return SkillStart(skill, goal, "chaining")


class KeptSubgoals:
    """What was decided earlier in the episode, where a skill goes on with what its jaw holds.

    Args:
        source: who gives the subgoals of the other skills.
        starts: what was decided.
    """

    def __init__(self, source: SubgoalSource, starts: Iterable[SkillStart]) -> None:
        self._source, self._starts = source, {start.skill: start for start in starts}

    def __call__(self, skill: str, observation: FloatArray, scene: Scene) -> SkillStart:
        """The subgoal as it was decided; that of the source where nothing was."""
        kept = self._starts.get(skill)
        return self._source(skill, observation, scene) if kept is None else kept


def check_reachable(skill: str, subgoal: FloatArray, cell: CellDescription) -> None:
    """Refuses a subgoal whose positions no arm of the cell comes near.

    Args:
        skill: whose subgoal it is.
        subgoal: two positions first, m, task frame.
        cell: gives the workspaces.

    Raises:
        MotionError: names the position and how far outside it lies.
    """
    low = np.min([arm.entry.workspace_lower_m for arm in cell.arms], axis=0)
    high = np.max([arm.entry.workspace_upper_m for arm in cell.arms], axis=0)
    for position in subgoal[:CHOSEN_SIZE].reshape(2, 3):
        outside = np.maximum(low - position, position - high)
        if not outside.max() <= FAR_OUTSIDE_M:
            place = ", ".join(f"{1e3 * x:.1f}" for x in position)
            raise MotionError(
                f"the subgoal chosen for {skill!r} holds the position ({place}) mm, "
                f"{1e3 * outside.max():.1f} mm outside the workspace of every arm (allowed: "
                f"{1e3 * FAR_OUTSIDE_M:.0f} mm); look at the scene and its frame, or train the "
                "chaining policy again"
            )
