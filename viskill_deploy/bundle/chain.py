"""Running the skills of a bundle in order, each for its whole budget of policy steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from viskill_deploy.bundle.format import ORT_ERRORS, Bundle
from viskill_deploy.core.errors import BundleError
from viskill_deploy.core.types import FloatArray

SubgoalSource = Callable[[str, FloatArray], FloatArray]
"""(skill's name, observation at its start) → subgoal in the task frame."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What the chain wants in one policy step.

    Attributes:
        skill: name of the running skill.
        step: policy steps that it has taken before this one.
        action: five numbers an arm in [-1, 1].
        subgoal: what the skill was told to reach.
        may_open_jaw: per arm.
    """

    skill: str
    step: int
    action: FloatArray
    subgoal: FloatArray
    may_open_jaw: tuple[bool, ...]


class SkillChain:
    """The policy of a bundle: skills in order, a subgoal for each at its first step.

    Args:
        bundle: a loaded bundle.
        subgoals: who gives the subgoals.
    """

    def __init__(self, bundle: Bundle, subgoals: SubgoalSource) -> None:
        self._bundle, self._subgoals = bundle, subgoals
        self._skill, self._step = 0, 0
        self._goal: FloatArray | None = None

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

    def act(self, observation: FloatArray) -> Choice:
        """The next action, and one step of the running skill's budget."""
        entry = self._bundle.manifest.skills[self._skill]
        if self._goal is None:
            self._goal = np.asarray(self._subgoals(entry.name, observation), dtype=np.float64)
        feed = {
            "obs": observation[None].astype(np.float32),
            "goal": self._goal[None].astype(np.float32),
        }
        try:
            (action,) = self._bundle.sessions[entry.name].run(["action"], feed)
        except ORT_ERRORS as error:
            raise BundleError(self._bundle.path / entry.file, f"cannot run: {error}") from error
        choice = Choice(
            entry.name, self._step, action[0].astype(np.float64), self._goal, entry.may_open_jaw
        )
        self._step += 1
        if self._step == entry.budget:
            self._skill, self._step, self._goal = self._skill + 1, 0, None
        return choice
