"""Running the skills of a bundle in order, each for its whole budget of policy steps."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from viskill_deploy.bundle.format import Bundle
from viskill_deploy.bundle.subgoals import SubgoalSource
from viskill_deploy.core.errors import MotionError
from viskill_deploy.core.types import FloatArray, Scene, SkillStart

ROUNDING = 1e-6
"""A float32 probability may miss [0, 1] by this much."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What the chain wants in one policy step.

    Attributes:
        start: what was decided at the running skill's first step.
        step: policy steps that it has taken before this one.
        action: five numbers an arm in [-1, 1].
        may_open_jaw: per arm.
    """

    start: SkillStart
    step: int
    action: FloatArray
    may_open_jaw: tuple[bool, ...]

    @property
    def skill(self) -> str:
        """Name of the running skill."""
        return self.start.skill


class SkillChain:
    """The policy of a bundle: skills in order, a subgoal and a value for each at its first step.

    Args:
        bundle: a loaded bundle.
        subgoals: who gives the subgoals.
        first: name of the skill to begin with; the bundle's first by default.
    """

    def __init__(self, bundle: Bundle, subgoals: SubgoalSource, first: str = "") -> None:
        self._bundle, self._subgoals = bundle, subgoals
        names = [skill.name for skill in bundle.manifest.skills]
        self._skill, self._step = names.index(first or names[0]), 0
        self._start: SkillStart | None = None

    @property
    def finished(self) -> bool:
        """Whether every skill has used its budget."""
        return self._skill >= len(self._bundle.manifest.skills)

    @property
    def between_skills(self) -> bool:
        """Whether the next action is the first of a skill, or there is none."""
        return self._step == 0

    @property
    def steps(self) -> int:
        """Policy steps of the whole chain."""
        return sum(skill.budget for skill in self._bundle.manifest.skills)

    def act(self, observation: FloatArray, scene: Scene) -> Choice:
        """The next action, and one step of the running skill's budget.

        Args:
            observation: what the policy sees now.
            scene: what it was made from; looked at in a skill's first step alone.

        Raises:
            BundleError: a graph cannot run.
            MotionError: a subgoal or a value makes no sense.
        """
        entry = self._bundle.manifest.skills[self._skill]
        if self._start is None:
            self._start = self._begin(entry.name, observation, scene)
        action = self._bundle.skills[entry.name](observation, self._start.subgoal)
        choice = Choice(self._start, self._step, action, entry.may_open_jaw)
        self._step += 1
        if self._step == entry.budget:
            self._skill, self._step, self._start = self._skill + 1, 0, None
        return choice

    def _begin(self, skill: str, observation: FloatArray, scene: Scene) -> SkillStart:
        start = self._subgoals(skill, observation, scene)
        return replace(start, value=value_at(self._bundle, start, observation, scene))


def value_at(
    bundle: Bundle, start: SkillStart, observation: FloatArray, scene: Scene
) -> float | None:
    """The value where a skill is about to start; None where nothing tells it.

    It is P(the whole task succeeds), unless the manifest says that it is a return.

    Args:
        bundle: a loaded bundle.
        start: the skill and its subgoal.
        observation: what the policy sees.
        scene: what it was made from; gives the task's goal.

    Raises:
        BundleError: the graph cannot run.
        MotionError: what it answers is no probability.
    """
    if start.skill not in bundle.values:
        return None
    (value,) = bundle.values[start.skill](observation, scene.goal, start.subgoal).tolist()
    table = bundle.manifest.value
    if table is not None and table.meaning == "return" and math.isfinite(value):
        return float(value)
    if not -ROUNDING <= value <= 1.0 + ROUNDING:
        raise MotionError(
            f"the value at the start of {start.skill!r} is {value:.4g}, no probability; look at "
            "the observation, or train the value again"
        )
    return float(min(max(value, 0.0), 1.0))
