"""A skill's network: observation and subgoal in metres and radians → action in [-1, 1].

Its inputs are scaled by fixed numbers from the cell's workspace, never by statistics of the data: a
normaliser that drifts takes a good policy down with it. Distances between the tips and everything
else are given twice, once on the scale of the workspace and once on that of a finger, because a
grasp is decided within a millimetre.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
import torch
from torch import nn

from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.tasks.base import Task

HIDDEN = 256
LAYERS = 3
COARSE_M = 0.05
FINE_M = 0.005
EULER_SCALE_RAD = np.pi
JAW_SCALE_RAD = 0.5
TURN_GAIN = 5.0


@dataclass(frozen=True, slots=True)
class Scaling:
    """Fixed features of the vector [observation, goal] of length n.

    Attributes:
        centre: subtracted, (n,).
        scale: then divided by, (n,).
        differences: rows that give distances in m, (m, n).
        turns: rows that give angles between jaws and what they hold, (k, n).
    """

    centre: FloatArray
    scale: FloatArray
    differences: FloatArray
    turns: FloatArray

    @property
    def width(self) -> int:
        """Number of features."""
        return len(self.centre) + 2 * len(self.differences) + len(self.turns)


def scaling_of(task: Task) -> Scaling:
    """The scaling of a task's inputs, from the names in its layouts and the cell's workspace."""
    starts: dict[str, int] = {}
    size = 0
    for name, length in (*task.observation_layout, *task.goal_layout):
        starts[name], size = size, size + length
    entries = [arm.entry for arm in task.cell.arms]
    low = np.min([e.workspace_lower_m for e in entries], axis=0)
    high = np.max([e.workspace_upper_m for e in entries], axis=0)
    centre, scale = np.zeros(size), np.ones(size)
    for name, at in starts.items():
        if name.endswith("_position"):
            centre[at : at + 3], scale[at : at + 3] = (low + high) / 2, (high - low) / 2
        elif name.endswith("_euler"):
            scale[at : at + 3] = EULER_SCALE_RAD
        elif name.endswith("_jaw"):
            scale[at] = JAW_SCALE_RAD
        elif "_from_" in name:
            scale[at : at + 3] = COARSE_M
    tips = [f"{arm.name.lower()}_position" for arm in task.cell.arms]
    places = [name for name in starts if name.endswith("_position") and name not in tips]
    goals = [name for name, _ in task.goal_layout if name.endswith("_position")]
    pairs = [*product(places, tips), *product(goals, ["object_position"])]
    differences = np.zeros((3 * len(pairs), size))
    for row, (a, b) in enumerate(pairs):
        for axis in range(3):
            differences[3 * row + axis, [starts[a] + axis, starts[b] + axis]] = 1.0, -1.0
    hands = [f"{arm.name.lower()}_euler" for arm in task.cell.arms]
    frames = [name for name in starts if name.endswith("_euler") and name not in hands]
    turns = np.zeros((len(hands) * len(frames), size))
    for row, (a, b) in enumerate(product(frames, hands)):
        turns[row, [starts[a] + 2, starts[b] + 2]] = 1.0, -1.0
    return Scaling(centre, scale, differences, turns)


class SkillNetwork(nn.Module):  # type: ignore[misc]  # torch is not type-checked here
    """Three hidden layers of 256 on the scaled inputs, tanh at the end.

    Args:
        scaling: of the inputs.
        actions: length of the action.
    """

    def __init__(self, scaling: Scaling, actions: int) -> None:
        super().__init__()
        for name in ("centre", "scale", "differences", "turns"):
            values = torch.tensor(getattr(scaling, name), dtype=torch.float32)
            self.register_buffer(name, values, persistent=False)
        widths = [scaling.width, *[HIDDEN] * LAYERS, actions]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))

    def features(self, obs: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        """Scaled inputs, (N, width)."""
        x = torch.cat([obs, goal], dim=1)
        distances = x @ self.differences.T
        turns = torch.sin(2.0 * (x @ self.turns.T))  # a jaw turned by pi is the same jaw
        parts = [
            (x - self.centre) / self.scale,
            distances / COARSE_M,
            torch.tanh(distances / FINE_M),
            torch.tanh(TURN_GAIN * turns),
        ]
        return torch.cat(parts, dim=1)

    def forward(self, obs: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
        """Actions (N, k) for observations (N, n) and goals (N, m)."""
        return self.act(self.features(obs, goal))

    def act(self, features: torch.Tensor) -> torch.Tensor:
        """Actions (N, k) for features (N, width)."""
        for layer in self.layers[:-1]:
            features = torch.relu(layer(features))
        return torch.tanh(self.layers[-1](features))

    def weights(self) -> dict[str, FloatArray]:
        """Trained numbers by name, float32."""
        return {key: value.detach().numpy().copy() for key, value in self.state_dict().items()}

    def load(self, weights: dict[str, FloatArray]) -> None:
        """Takes over numbers of `weights`."""
        self.load_state_dict({key: torch.tensor(value) for key, value in weights.items()})
