"""What a task is, and finding one by name: a name is a file in this folder."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, cast

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.core.types import ActiveObject, FloatArray, Scene
from viskill_deploy.motion.waypoints import ActionSpec

PACKAGE = "viskill_deploy.sim.tasks"


@dataclass(frozen=True, slots=True)
class SkillSpec:
    """One skill of a task.

    Attributes:
        name: such as "grasp".
        budget: policy steps that it always takes.
        may_open_jaw: per arm, whether it may open a jaw that holds something.
        holds: per arm, whether its jaw has to hold something when the skill has ended; () where
            no jaw has anything to hold.
    """

    name: str
    budget: int
    may_open_jaw: tuple[bool, ...]
    holds: tuple[bool, ...] = ()


AnyFloatArray = npt.NDArray[np.floating[Any]]
"""Numbers of the control loop (64 bits) or of learning (32 bits)."""

Layout = tuple[tuple[str, int], ...]
"""Names and sizes of the stretches of a vector."""


class Task(Protocol):
    """A task: pure functions of what is seen. Lengths in m, task frame, angles in rad.

    Learning runs many environments side by side. A task whose class says `batched = True` promises
    that `observe`, `scripted_action`, `achieved` and `skill_success` take arrays with any leading
    dimensions and give each environment what it would get alone: index with `...`, join along
    `axis=-1`, decide with `np.where`. The scene is then a `sim.vector_scenes.Scenes`, which reads
    as a `Scene` does: `scene.pose(scene.active)` is (N, 4, 4), `scene.goal` is (N, 3). The
    functions of other tasks are called for one environment after the other: the same, but slower.
    """

    @property
    def name(self) -> str:
        """The file's name."""
        ...

    @property
    def cell(self) -> CellDescription:
        """Where it is done."""
        ...

    @property
    def skills(self) -> tuple[SkillSpec, ...]:
        """Its skills in order."""
        ...

    @property
    def action(self) -> ActionSpec:
        """Meaning of its actions."""
        ...

    @property
    def observation_layout(self) -> Layout:
        """What the observation is made of."""
        ...

    @property
    def goal_layout(self) -> Layout:
        """What a subgoal is made of."""
        ...

    @property
    def distributions(self) -> tuple[str, ...]:
        """Names that `sample_layout` knows."""
        ...

    def sample_layout(self, rng: np.random.Generator, distribution: str) -> Scene:
        """Objects and goal of a new episode; raises ValueError for an unknown distribution."""
        ...

    def observe(
        self,
        T_task_tip: Sequence[FloatArray],
        jaws: Sequence[float | FloatArray],
        scene: Scene,
    ) -> FloatArray:
        """The policy's observation from measured tips (4, 4), jaw openings and the scene."""
        ...

    def subgoals(
        self, observation: FloatArray, scene: Scene, rng: np.random.Generator
    ) -> dict[str, FloatArray]:
        """The scripted plan's subgoal of every skill, from the first observation of an episode."""
        ...

    def scripted_action(
        self, skill: str, observation: AnyFloatArray, subgoal: AnyFloatArray
    ) -> FloatArray:
        """The scripted controller's action, five numbers an arm in [-1, 1]."""
        ...

    def complete_subgoal(
        self, skill: str, positions: FloatArray, observation: FloatArray, scene: Scene
    ) -> FloatArray:
        """The subgoal of a skill before the last one, from what a chaining policy chose, (6,).

        Adds the flags, and overrules the choice where the task leaves none.
        """
        ...

    def final_subgoal(self, observation: FloatArray, scene: Scene) -> FloatArray:
        """The last skill's subgoal, from the task's own goal and what is seen at its start."""
        ...

    def flags(self, thing: ActiveObject) -> tuple[bool, ...]:
        """The contacts that subgoals speak of, in the order of a subgoal's flags."""
        ...

    def achieved(
        self, skill: str, observation: AnyFloatArray, flags: Sequence[bool] | AnyFloatArray
    ) -> FloatArray:
        """What stands where the skill's subgoal would stand, from what is seen."""
        ...

    def skill_success(
        self, skill: str, achieved: AnyFloatArray, subgoal: AnyFloatArray
    ) -> npt.NDArray[np.bool_]:
        """Whether a skill has reached its subgoal; (..., m) and (..., m) give (...)."""
        ...

    def success(self, thing: ActiveObject, scene: Scene) -> bool:
        """Whether the whole task is done, judged at the last step."""
        ...


def task_names() -> list[str]:
    """Every task there is, sorted."""
    package = importlib.import_module(PACKAGE)
    files = (module.name for module in pkgutil.iter_modules(package.__path__))
    return sorted(name for name in files if name != "base" and not name.endswith("_script"))


def load_task(name: str, cell: CellDescription | None = None) -> Task:
    """The task in the file `sim/tasks/<name>.py`.

    Args:
        name: the task's name.
        cell: the cell to do it in; the cell file of the same name by default.

    Raises:
        DataFileError: there is no such task.
    """
    if name not in task_names():
        raise DataFileError(name, "task", f"is unknown; choose one of {', '.join(task_names())}")
    module = importlib.import_module(f"{PACKAGE}.{name}")
    return cast(Task, module.make(cell or load_cell(name)))
