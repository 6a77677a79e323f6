"""ViSkill's chaining: which subgoal makes it most likely that the whole task succeeds.

T. Huang et al., "Value-Informed Skill Chaining for Policy Learning of Long-Horizon Tasks with
Surgical Robot", IROS 2023. Skills are frozen. The value of a subgoal at the start of a skill is the
probability that the whole task succeeds; it is learned backwards from the outcome without discount
(equation 3), and the chaining policies climb it while they also imitate subgoals that were reached
(SAC with self-imitation, no entropy).

Differences from the official code, all deliberate: the policy gradient really runs; values learn
from all transitions alike, not from reached subgoals twice, which makes them too high; rewards of
the last skill stay with their episode; middle skills are judged by the subgoal that they were
given; inputs are scaled; values are probabilities, fitted by cross-entropy, which has its minimum
where the squared error has it.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch.nn import functional

from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.tasks.base import AnyFloatArray, Task
from viskill_deploy.train.network import Network, scaling_of
from viskill_deploy.train.optimiser import adam, descend, follow, frozen, restore, state_of
from viskill_deploy.train.replay import Float32Array
from viskill_deploy.train.subgoal_space import POSITIONS, SubgoalSpace, chain_layout, value_layout


@dataclass(frozen=True, slots=True)
class ChainSettings:
    """Numbers of the algorithm.

    Attributes:
        rate: of Adam, for policies and values.
        tau: part by which target values follow after every step.
        batch: transitions in a batch.
        policy_gradient: whether policies climb the value; without it only self-imitation is left.
        imitation: lambda, the weight of self-imitation beside it.
        temperature: of the advantage in the weights of self-imitation.
        hidden: width of the hidden layers.
        decay: weight decay of the values: a few hundred episodes are soon known by heart, and a
            value that knows them by heart is sure of what it has not seen.
    """

    rate: float = 3e-4
    tau: float = 0.005
    batch: int = 128
    policy_gradient: bool = True
    imitation: float = 0.1
    temperature: float = 1.0
    hidden: int = 256
    decay: float = 0.01


@dataclass(frozen=True, slots=True)
class Transitions:
    """What happened between the start of one skill and the start of the next.

    Attributes:
        obs, task_goal: at the start, (B, n), (B, 3).
        positions: the subgoal's, (B, 6).
        next_obs: at the start of the next skill, (B, n).
        next_positions: the next skill's subgoal as it was, (B, 6).
        ended: the episode ended here: it could not be followed, or this is the last skill, (B,).
        outcome: whether the whole task succeeded in the end, (B,).
        next_reached: whether the next skill reached its subgoal, (B,).
    """

    obs: Float32Array
    task_goal: Float32Array
    positions: Float32Array
    next_obs: Float32Array
    next_positions: Float32Array
    ended: Float32Array
    outcome: Float32Array
    next_reached: Float32Array


class Policy:
    """A Gaussian chaining policy squashed into the subgoal space."""

    def __init__(self, network: Network, free: FloatArray) -> None:
        self.network, self.free = network, torch.tensor(free, dtype=torch.float32)

    def parameters(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean before the squash and log of the standard deviation in [-5, 2], (N, 6) each."""
        mean, raw = self.network.head(features).split(POSITIONS, dim=1)
        return mean, -5.0 + 3.5 * (torch.tanh(raw) + 1.0)

    def log_probability(self, features: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
        """Log density of images in (-1, 1), over the free entries, (N,)."""
        mean, log_std = self.parameters(features)
        before = torch.atanh(image)
        normal = -0.5 * ((before - mean) / log_std.exp()) ** 2 - log_std - 0.9189385332046727
        squash = torch.log1p(-(image**2) + 1e-6)
        return ((normal - squash) * self.free).sum(dim=1)


class Chaining:
    """Chaining policies of all skills but the last, and values of all of them.

    Args:
        task: the task.
        settings: numbers of the algorithm.
        seed: of the first weights.
    """

    def __init__(self, task: Task, settings: ChainSettings, seed: int) -> None:
        self.task, self.settings, self.space = task, settings, SubgoalSpace.of(task)
        chain, judge = scaling_of(task, chain_layout(task)), scaling_of(task, value_layout(task))
        self.skills = len(task.skills)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            networks = [
                Network(chain, 2 * POSITIONS, hidden=settings.hidden)
                for _ in range(self.skills - 1)
            ]
            self.values = [
                tuple(Network(judge, 1, hidden=settings.hidden) for _ in range(2))
                for _ in range(self.skills)
            ]
        self.policies = [Policy(n, f) for n, f in zip(networks, self.space.free, strict=False)]
        self.targets = copy.deepcopy(self.values)
        self.noise = np.random.default_rng((seed, 3))
        self._policy_optimisers = [adam(n, settings.rate) for n in networks]
        self._value_optimisers = [
            tuple(adam(n, settings.rate, settings.decay) for n in pair) for pair in self.values
        ]

    def choose(
        self,
        index: int,
        obs: AnyFloatArray,
        task_goal: AnyFloatArray,
        rng: np.random.Generator | None = None,
    ) -> FloatArray:
        """Positions (N, 6) m that a policy chooses; its mean without `rng`, else a sample."""
        policy = self.policies[index]
        with torch.no_grad():
            x = policy.network.features(_tensor(np.concatenate([obs, task_goal], axis=1)))
            mean, log_std = policy.parameters(x)
        before = mean.numpy().astype(np.float64)
        if rng is not None:
            before = before + rng.standard_normal(before.shape) * np.exp(log_std.numpy())
        return self.space.positions(np.tanh(before))

    def probability(
        self,
        index: int,
        obs: AnyFloatArray,
        task_goal: AnyFloatArray,
        positions: AnyFloatArray,
    ) -> FloatArray:
        """P(the whole task succeeds) at the start of a skill with a subgoal, (N,).

        The first of the two networks says it. The smaller of both, which learning climbs, is too
        low.
        """
        with torch.no_grad():
            x = _tensor(np.concatenate([obs, task_goal, positions[:, :POSITIONS]], axis=1))
            logit = self.values[index][0](x)[:, 0]
        probability: FloatArray = torch.sigmoid(logit).numpy().astype(np.float64)
        return probability

    def update(
        self, index: int, online: Transitions, reached: Transitions | None
    ) -> dict[str, float]:
        """One step of a skill's values and policy.

        Args:
            index: of the skill.
            online: any transitions.
            reached: transitions whose skill reached its subgoal, to imitate; None where there are
                none. Values never learn from them alone: they are chosen by what happened later.
        """
        line = {"value": self._step_values(index, online)}
        if index == self.skills - 1:
            return line
        loss = torch.zeros(())
        if self.settings.policy_gradient:
            climb = self.climb_loss(index, online)
            loss, line["climb"] = loss + climb, float(climb.detach())
        if reached is not None:
            imitation = self.imitation_loss(index, reached)
            loss = loss + self.settings.imitation * imitation
            line["imitation"] = float(imitation.detach())
        if loss.requires_grad:
            descend(self._policy_optimisers[index], loss)
        return line

    def value_target(self, index: int, batch: Transitions) -> torch.Tensor:
        """What the value of a skill's subgoal should be, (B,).

        The last skill's, and where an episode ends: the outcome. The skill before the last: the
        outcome too, because the last one leaves no choice and its outcome belongs to the episode.
        Others: the next skill's value of what its policy would choose, the mean of both networks:
        the smaller one would make earlier skills look worse than they are.
        """
        outcome = _tensor(batch.outcome)
        if index >= self.skills - 2:
            return outcome
        follower = self.policies[index + 1]
        with torch.no_grad():
            x = _tensor(np.concatenate([batch.next_obs, batch.task_goal], axis=1))
            mean, log_std = follower.parameters(follower.network.features(x))
            noise = self._noise(mean)
            chosen = torch.tanh(mean + noise * log_std.exp())
            free = follower.free > 0.0
            given = torch.where(free, self._metres(chosen), _tensor(batch.next_positions))
            later = self._mean(self.targets[index + 1], x, given)
        return torch.where(_tensor(batch.ended) > 0.0, outcome, later)

    def value_loss(self, index: int, batch: Transitions, target: torch.Tensor) -> torch.Tensor:
        """Cross-entropy of both values against the target, summed."""
        x = self._judged(batch)
        loss = torch.zeros(())
        for network in self.values[index]:
            logit = network(x)[:, 0]
            loss = loss + functional.binary_cross_entropy_with_logits(logit, target)
        return loss

    def climb_loss(self, index: int, batch: Transitions) -> torch.Tensor:
        """Minus the smaller value of what the policy chooses."""
        policy = self.policies[index]
        x = _tensor(np.concatenate([batch.obs, batch.task_goal], axis=1))
        mean, log_std = policy.parameters(policy.network.features(x))
        noise = self._noise(mean)
        chosen = self._metres(torch.tanh(mean + noise * log_std.exp()))
        given = torch.where(policy.free > 0.0, chosen, _tensor(batch.positions))
        pair = self.values[index]
        with frozen(pair[0]), frozen(pair[1]):
            return -self._least(pair, x, given).mean()

    def imitation_loss(self, index: int, batch: Transitions) -> torch.Tensor:
        """Minus the log density of reached subgoals, weighted by their advantage."""
        policy = self.policies[index]
        with torch.no_grad():
            x = _tensor(np.concatenate([batch.obs, batch.task_goal], axis=1))
            features = policy.network.features(x)
            mean, log_std = policy.parameters(features)
            sample = self._metres(torch.tanh(mean + self._noise(mean) * log_std.exp()))
            given = _tensor(batch.positions)
            ours = torch.where(policy.free > 0.0, sample, given)
            pair = self.values[index]
            advantage = self._least(pair, x, given) - self._least(pair, x, ours)
            weight = torch.softmax(advantage / self.settings.temperature, dim=0)
        return -(weight * policy.log_probability(features, self.space.image(given))).sum()

    def load(self, tree: dict[str, Any]) -> None:
        """Takes over policies and values of `weights`."""
        for part, policy in zip(tree["policies"], self.policies, strict=True):
            restore(part, policy.network)
        for parts, pair in zip(tree["values"], self.values, strict=True):
            for part, network in zip(parts, pair, strict=True):
                restore(part, network)

    def weights(self) -> dict[str, Any]:
        """Policies and values without what only learning needs."""
        return {
            "policies": [state_of(policy.network) for policy in self.policies],
            "values": [[state_of(network) for network in pair] for pair in self.values],
        }

    def _step_values(self, index: int, batch: Transitions) -> float:
        loss = self.value_loss(index, batch, self.value_target(index, batch))
        for optimiser in self._value_optimisers[index]:
            optimiser.zero_grad(set_to_none=True)
        torch.autograd.backward(loss)
        for optimiser in self._value_optimisers[index]:
            optimiser.step()
        for target, source in zip(self.targets[index], self.values[index], strict=True):
            follow(target, source, self.settings.tau)
        return float(loss.detach())

    def _least(
        self, pair: Sequence[Network], x: torch.Tensor, positions: torch.Tensor
    ) -> torch.Tensor:
        return _both(pair, x, positions).min(dim=1).values

    def _mean(
        self, pair: Sequence[Network], x: torch.Tensor, positions: torch.Tensor
    ) -> torch.Tensor:
        return _both(pair, x, positions).mean(dim=1)

    def _judged(self, batch: Transitions) -> torch.Tensor:
        return _tensor(np.concatenate([batch.obs, batch.task_goal, batch.positions], axis=1))

    def _metres(self, image: torch.Tensor) -> torch.Tensor:
        return _tensor(self.space.centre) + _tensor(self.space.half) * image

    def _noise(self, like: torch.Tensor) -> torch.Tensor:
        return _tensor(self.noise.standard_normal(like.shape))

    def state(self) -> dict[str, Any]:
        """Everything that learning goes on from."""
        return {
            "noise": self.noise.bit_generator.state,
            "policies": [
                state_of(policy.network, optimiser)
                for policy, optimiser in zip(self.policies, self._policy_optimisers, strict=True)
            ],
            "values": [
                [state_of(n, o) for n, o in zip(pair, optimisers, strict=True)]
                for pair, optimisers in zip(self.values, self._value_optimisers, strict=True)
            ],
            "targets": [[state_of(n) for n in pair] for pair in self.targets],
        }

    def restore(self, tree: dict[str, Any]) -> None:
        """Takes over what `state` gave."""
        self.noise.bit_generator.state = tree["noise"]
        for part, policy, optimiser in zip(
            tree["policies"], self.policies, self._policy_optimisers, strict=True
        ):
            restore(part, policy.network, optimiser)
        for parts, pair, optimisers in zip(
            tree["values"], self.values, self._value_optimisers, strict=True
        ):
            for part, network, optimiser in zip(parts, pair, optimisers, strict=True):
                restore(part, network, optimiser)
        for parts, pair in zip(tree["targets"], self.targets, strict=True):
            for part, network in zip(parts, pair, strict=True):
                restore(part, network)


def _both(pair: Sequence[Network], x: torch.Tensor, positions: torch.Tensor) -> torch.Tensor:
    """Probabilities of both networks, (N, 2)."""
    judged = torch.cat([x, positions], dim=1)
    return torch.sigmoid(torch.cat([network(judged) for network in pair], dim=1))


def _tensor(values: AnyFloatArray) -> torch.Tensor:
    return torch.from_numpy(np.asarray(values, dtype=np.float32))
