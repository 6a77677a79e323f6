"""How much a state looks like one from which a skill was demonstrated to begin."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import torch
from torch.nn import functional

from viskill_deploy.sim.tasks.base import Task
from viskill_deploy.train.network import Network, scaling_of
from viskill_deploy.train.optimiser import adam, descend
from viskill_deploy.train.replay import Float32Array

RATE = 3e-4


class Measure(Protocol):
    """Says how much a state is like a demonstrated start of a skill."""

    def of(self, obs: Float32Array) -> Float32Array:
        """Likeness of states (N, n), in [0, 1], (N,)."""
        ...


class Likeness:
    """A learned measure: a discriminator between demonstrated starts and states met otherwise.

    Args:
        task: the task.
        starts: observations from which the skill was demonstrated, (S, n).
        seed: of the weights and batches.
        hidden: width of the hidden layers.
    """

    def __init__(self, task: Task, starts: Float32Array, seed: int, hidden: int = 128) -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.network = Network(scaling_of(task, task.observation_layout), 1, hidden=hidden)
        self.optimiser = adam(self.network, RATE)
        self.starts = starts

    def of(self, obs: Float32Array) -> Float32Array:
        """Probability that a state is a demonstrated start, (N,)."""
        with torch.no_grad():
            logit = self.network(torch.from_numpy(obs))[:, 0]
        likeness: Float32Array = torch.sigmoid(logit).numpy()
        return likeness

    def update(self, met: Float32Array, rng: np.random.Generator) -> float:
        """One step: demonstrated starts count as 1, states `met` (N, n) as 0."""
        rows = rng.integers(len(self.starts), size=len(met))
        x = torch.from_numpy(np.concatenate([self.starts[rows], met]))
        label = torch.cat([torch.ones(len(met)), torch.zeros(len(met))])
        loss = functional.binary_cross_entropy_with_logits(self.network(x)[:, 0], label)
        descend(self.optimiser, loss)
        return float(loss.detach())


class Nearness:
    """A plain measure: distance to the nearest demonstrated start in the space of features.

    Args:
        task: the task.
        starts: observations from which the skill was demonstrated, (S, n).
    """

    def __init__(self, task: Task, starts: Float32Array) -> None:
        self._network = Network(scaling_of(task, task.observation_layout), 1, hidden=1)
        self._starts = self._features(starts)
        apart = torch.cdist(self._starts, self._starts)
        apart.fill_diagonal_(float("inf"))
        self._scale = float(apart.min(dim=1).values.median())

    def of(self, obs: Float32Array) -> Float32Array:
        """exp(-distance / typical distance between neighbouring starts), in (0, 1], (N,)."""
        nearest = torch.cdist(self._features(obs), self._starts).min(dim=1).values
        likeness: Float32Array = torch.exp(-nearest / self._scale).numpy()
        return likeness

    def _features(self, obs: Float32Array) -> torch.Tensor:
        with torch.no_grad():
            return self._network.features(torch.from_numpy(obs))
