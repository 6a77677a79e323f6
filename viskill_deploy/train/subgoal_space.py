"""The subgoals that a chaining policy may choose: six positions in the workspace of the arms."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from viskill_deploy.core.types import FloatArray, Scene
from viskill_deploy.sim.tasks.base import Layout, Task
from viskill_deploy.train.network import TASK_GOAL

POSITIONS = 6
"""Numbers chosen: the positions at the front of every subgoal; flags follow behind them."""

MARGIN = 1.2
"""The space is larger than the workspace by this, so that its edge is not where tanh is flat."""


@dataclass(frozen=True)
class SubgoalSpace:
    """Positions and their images in (-1, 1).

    Attributes:
        centre, half: of the box, (6,) m.
        free: per skill, which of the six the chaining policy really chooses, (skills, 6); the task
            overrules the others.
    """

    centre: FloatArray
    half: FloatArray
    free: FloatArray

    @classmethod
    def of(cls, task: Task) -> SubgoalSpace:
        """The space of a task."""
        entries = [arm.entry for arm in task.cell.arms]
        low = np.min([e.workspace_lower_m for e in entries], axis=0)
        high = np.max([e.workspace_upper_m for e in entries], axis=0)
        rng = np.random.default_rng(0)
        scene = task.sample_layout(rng, task.distributions[0])
        free = [_free(task, skill.name, scene, rng) for skill in task.skills[:-1]]
        return cls(
            np.tile((low + high) / 2, 2),
            MARGIN * np.tile((high - low) / 2, 2),
            np.array([*free, np.zeros(POSITIONS)]),
        )

    def positions(self, image: FloatArray) -> FloatArray:
        """Positions (..., 6) m of images (..., 6) in (-1, 1)."""
        return self.centre + self.half * image

    def image(self, positions: torch.Tensor) -> torch.Tensor:
        """Images of positions, kept inside (-1, 1)."""
        centre, half = (torch.tensor(x, dtype=torch.float32) for x in (self.centre, self.half))
        return ((positions - centre) / half).clamp(-0.999, 0.999)


def _free(task: Task, skill: str, scene: Scene, rng: np.random.Generator) -> FloatArray:
    """Which chosen positions come through `complete_subgoal`."""
    obs = np.zeros(sum(n for _, n in task.observation_layout))
    chosen = rng.uniform(0.01, 0.02, (2, POSITIONS))
    given = [task.complete_subgoal(skill, c, obs, scene)[:POSITIONS] for c in chosen]
    free: FloatArray = (given[0] != given[1]).astype(np.float64)
    return free


def chain_layout(task: Task) -> Layout:
    """What a chaining policy sees: observation and task goal."""
    return (*task.observation_layout, *TASK_GOAL)


def value_layout(task: Task) -> Layout:
    """What a value function sees: observation, task goal, the six positions of the subgoal."""
    return (*chain_layout(task), ("subgoal1_position", 3), ("subgoal2_position", 3))
