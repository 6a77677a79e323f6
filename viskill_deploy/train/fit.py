"""Fitting one skill's network to labelled states."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from viskill_deploy.core.types import FloatArray
from viskill_deploy.train.episodes import Float32Array
from viskill_deploy.train.network import Scaling, SkillNetwork

LEARNING_RATE = 1e-3
FINAL_RATE = 1e-5
WEIGHT_DECAY = 1e-5


@dataclass(frozen=True, slots=True)
class Labelled:
    """Observations (n, o), subgoals (n, g) and wished actions (n, a)."""

    obs: Float32Array
    goal: Float32Array
    action: Float32Array

    def joined(self, other: Labelled) -> Labelled:
        """Both, one after the other."""
        return Labelled(
            np.concatenate([self.obs, other.obs]),
            np.concatenate([self.goal, other.goal]),
            np.concatenate([self.action, other.action]),
        )


@dataclass(frozen=True, slots=True)
class Fit:
    """What to do: cosine schedule over `updates` batches of `batch` states."""

    updates: int
    batch: int
    seed: int


def fit(
    scaling: Scaling, data: Labelled, start: dict[str, FloatArray] | None, how: Fit
) -> tuple[dict[str, FloatArray], float]:
    """Weights fitted by mean squared error, and the mean loss of the last tenth of the updates.

    Args:
        scaling: of the inputs.
        data: states and labels.
        start: weights to go on from; fresh ones if None.
        how: length and seed.
    """
    torch.set_num_threads(1)
    torch.manual_seed(how.seed)
    network = SkillNetwork(scaling, data.action.shape[1])
    if start is not None:
        network.load(start)
    with torch.no_grad():
        features = network.features(torch.from_numpy(data.obs), torch.from_numpy(data.goal))
    wished = torch.from_numpy(data.action)
    optimiser = torch.optim.AdamW(
        network.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY, fused=True
    )
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, how.updates, FINAL_RATE)
    rng = np.random.default_rng(how.seed)
    tail, total = max(1, how.updates // 10), 0.0
    for update in range(how.updates):
        rows = torch.from_numpy(rng.integers(len(wished), size=how.batch))
        loss = torch.mean((network.act(features[rows]) - wished[rows]) ** 2)
        optimiser.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        optimiser.step()
        schedule.step()
        if update >= how.updates - tail:
            total += float(loss.detach())
    mean = total / tail
    return network.weights(), mean if math.isfinite(mean) else math.inf
