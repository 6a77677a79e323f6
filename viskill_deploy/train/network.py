"""Networks on inputs in metres and radians: fixed features, then three hidden layers.

Inputs are scaled by fixed numbers from the cell's workspace, never by statistics of the data: a
normaliser that drifts takes a good policy down with it. Distances between things are given twice,
once on the scale of the workspace and once on that of a finger, because a grasp is decided within a
millimetre. Angles are also given as sine and cosine, because they wrap.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, pairwise, product

import numpy as np
import torch
from torch import nn

from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.tasks.base import Layout, Task

HIDDEN = 256
LAYERS = 3
COARSE_M = 0.05
FINE_M = 0.005
EULER_SCALE_RAD = np.pi
JAW_SCALE_RAD = 0.5
TURN_GAIN = 5.0

TASK_GOAL: Layout = (("task_goal_position", 3),)
"""Where the task's object has to go, as an input beside the observation."""


@dataclass(frozen=True, slots=True)
class Scaling:
    """Fixed features of an input vector of length n.

    Attributes:
        centre: subtracted, (n,).
        scale: then divided by, (n,).
        differences: rows that give distances in m, (m, n).
        turns: rows that give angles between jaws and what they hold, (k, n).
        angles: rows that pick the angles out, (e, n).
    """

    centre: FloatArray
    scale: FloatArray
    differences: FloatArray
    turns: FloatArray
    angles: FloatArray

    @property
    def width(self) -> int:
        """Number of features."""
        wide = len(self.centre) + 2 * len(self.differences)
        return wide + len(self.turns) + 2 * len(self.angles)


def size(layout: Layout) -> int:
    """Length of a vector with this layout."""
    return sum(length for _, length in layout)


def scaling_of(task: Task, layout: Layout | None = None) -> Scaling:
    """The scaling of an input, from the names in its layout and the cell's workspace.

    Args:
        task: the task.
        layout: names and sizes of the input; [observation, subgoal] by default.
    """
    layout = layout or (*task.observation_layout, *task.goal_layout)
    starts: dict[str, int] = {}
    length = 0
    for name, count in layout:
        starts[name], length = length, length + count
    entries = [arm.entry for arm in task.cell.arms]
    low = np.min([e.workspace_lower_m for e in entries], axis=0)
    high = np.max([e.workspace_upper_m for e in entries], axis=0)
    centre, scale = np.zeros(length), np.ones(length)
    for name, at in starts.items():
        if name.endswith("_position"):
            centre[at : at + 3], scale[at : at + 3] = (low + high) / 2, (high - low) / 2
        elif name.endswith("_euler"):
            scale[at : at + 3] = EULER_SCALE_RAD
        elif name.endswith("_jaw"):
            scale[at] = JAW_SCALE_RAD
        elif "_from_" in name:
            scale[at : at + 3] = COARSE_M
    hands = [f"{arm.name.lower()}_euler" for arm in task.cell.arms]
    frames = [name for name in starts if name.endswith("_euler") and name not in hands]
    turns = [(starts[a] + 2, starts[b] + 2) for a, b in product(frames, hands)]
    angles = [starts[n] + axis for n in starts if n.endswith("_euler") for axis in range(3)]
    return Scaling(
        centre,
        scale,
        _differences(_places(task, layout, starts), length),
        _differences(turns, length),
        np.eye(length)[angles].reshape(-1, length),
    )


def _places(task: Task, layout: Layout, starts: dict[str, int]) -> list[tuple[int, int]]:
    """Index pairs of the distances: everything to the tips, and goals to everything."""
    tips = [f"{arm.name.lower()}_position" for arm in task.cell.arms]
    seen = [n for n, _ in task.observation_layout if n.endswith("_position") and n not in tips]
    goals = [
        name
        for name, _ in layout
        if name.endswith("_position") and name not in tips and name not in seen
    ]
    pairs = [*product([*seen, *goals], tips), *product(goals, seen), *combinations(goals, 2)]
    wished = [(name, name.replace("_goal", "")) for name in seen if "_goal_position" in name]
    pairs += [pair for pair in wished if pair[1] in seen]
    return [(starts[a] + axis, starts[b] + axis) for a, b in pairs for axis in range(3)]


def _differences(pairs: list[tuple[int, int]], length: int) -> FloatArray:
    rows = np.zeros((len(pairs), length))
    for row, (a, b) in enumerate(pairs):
        rows[row, a], rows[row, b] = 1.0, -1.0
    return rows


class Network(nn.Module):  # type: ignore[misc]  # torch is not type-checked here
    """Three hidden layers on the features of one input vector, and a linear output.

    Args:
        scaling: of the input.
        outputs: length of the output.
        extra: numbers that join the features as they are, such as an action.
        hidden: width of the hidden layers.
    """

    def __init__(
        self, scaling: Scaling, outputs: int, extra: int = 0, hidden: int = HIDDEN
    ) -> None:
        super().__init__()
        for name in ("centre", "scale", "differences", "turns", "angles"):
            values = torch.tensor(getattr(scaling, name), dtype=torch.float32)
            self.register_buffer(name, values, persistent=False)
        widths = [scaling.width + extra, *[hidden] * LAYERS, outputs]
        self.layers = nn.ModuleList(nn.Linear(a, b) for a, b in pairwise(widths))

    def features(self, x: torch.Tensor) -> torch.Tensor:
        """Features (N, width) of inputs (N, n)."""
        distances = x @ self.differences.T
        turns = torch.sin(2.0 * (x @ self.turns.T))  # a jaw turned by pi is the same jaw
        angles = x @ self.angles.T
        parts = [
            (x - self.centre) / self.scale,
            distances / COARSE_M,
            torch.tanh(distances / FINE_M),
            torch.tanh(TURN_GAIN * turns),
            torch.sin(angles),
            torch.cos(angles),
        ]
        return torch.cat(parts, dim=1)

    def head(self, features: torch.Tensor) -> torch.Tensor:
        """Outputs (N, k) for features with their extra numbers (N, width + extra)."""
        for layer in self.layers[:-1]:
            features = torch.relu(layer(features))
        output: torch.Tensor = self.layers[-1](features)
        return output

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Outputs (N, k) for inputs (N, n)."""
        return self.head(self.features(x))

    @property
    def is_finite(self) -> bool:
        """Whether every trained number is one; a diverged network's are not."""
        return all(bool(torch.isfinite(value).all()) for value in self.state_dict().values())

    def weights(self) -> dict[str, FloatArray]:
        """Trained numbers by name, float32."""
        return {key: value.detach().numpy().copy() for key, value in self.state_dict().items()}

    def load(self, weights: dict[str, FloatArray]) -> None:
        """Takes over numbers of `weights`."""
        self.load_state_dict({key: torch.tensor(value) for key, value in weights.items()})
