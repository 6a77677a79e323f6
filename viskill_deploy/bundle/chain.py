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
    """

    def __init__(self, bundle: Bundle, subgoals: SubgoalSource) -> None:
        self._bundle, self._subgoals = bundle, subgoals
        self._skill, self._step = 0, 0
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
        if skill not in self._bundle.values:
            return start
        (value,) = self._bundle.values[skill](observation, scene.goal, start.subgoal).tolist()
        table = self._bundle.manifest.value
        if table is not None and table.meaning == "return" and math.isfinite(value):
            return replace(start, value=value)
        if not -ROUNDING <= value <= 1.0 + ROUNDING:
            raise MotionError(
                f"the value at the start of {skill!r} is {value:.4g}, no probability; look at the "
                "observation, or train the value again"
            )
        return replace(start, value=min(max(value, 0.0), 1.0))
