"""DEX: off-policy learning of one skill, guided by its demonstrations.

T. Huang et al., "Demonstration-Guided Reinforcement Learning with Efficient Exploration for Task
Automation of Surgical Robot", ICRA 2023; subgoal-conditioned as in ViSkill, equation 1. Actor and
critic are deterministic policy gradient; both are told how far the actor is from what would have
been demonstrated. The paper asks the nearest demonstrated states what that is (`guidance`
"neighbours"); by default the policy that imitates the demonstrations answers here ("imitation"),
which comes nearer to the script where a millimetre decides.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch

from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.tasks.base import AnyFloatArray
from viskill_deploy.train.network import Network, Scaling
from viskill_deploy.train.optimiser import adam, descend, follow, frozen, restore, state_of
from viskill_deploy.train.replay import Batch, Float32Array


@dataclass(frozen=True, slots=True)
class DexSettings:
    """Numbers of the algorithm.

    Attributes:
        discount: gamma, per policy step.
        closeness: alpha, the price of being away from the demonstrations; the paper has 5, under
            which a critic that has just begun drags the actor away from what it imitates.
        guidance: who tells what would have been demonstrated.
        neighbours: demonstrated states that speak for a state.
        critic_first: updates of the critic alone, before the actor follows it.
        actor_rate, critic_rate: of Adam.
        tau: part by which the targets follow after every step.
        batch: transitions from experience, and as many from demonstrations.
        hindsight: part of them with goals in hindsight.
        noise: standard deviation of exploration.
        hidden: width of the hidden layers.
    """

    discount: float = 0.99
    closeness: float = 50.0
    guidance: Literal["imitation", "neighbours"] = "imitation"
    neighbours: int = 5
    critic_first: int = 1000
    actor_rate: float = 3e-5
    critic_rate: float = 1e-3
    tau: float = 0.05
    batch: int = 128
    hindsight: float = 0.8
    noise: float = 0.1
    hidden: int = 256


def squared_distance(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Mean squared difference of actions (N, k), as (N,)."""
    return ((a - b) ** 2).mean(dim=1)


def propagated_action(
    states: torch.Tensor, demo_states: torch.Tensor, demo_actions: torch.Tensor, k: int
) -> torch.Tensor:
    """What the nearest demonstrations did: the softmax-weighted mean of k actions.

    Args:
        states: features to be advised on, (N, f).
        demo_states: features of demonstrated states, (M, f).
        demo_actions: what was done there, (M, a).
        k: how many of them speak.
    """
    distance, index = torch.cdist(states, demo_states).topk(k, dim=1, largest=False)
    weight = torch.softmax(-torch.sqrt(distance), dim=1)
    return (weight[:, :, None] * demo_actions[index]).sum(dim=1)


class Dex:
    """One skill's actor and critic.

    Args:
        scaling: of [observation, goal].
        actions: length of the action.
        settings: numbers of the algorithm.
        seed: of the first weights.
    """

    def __init__(self, scaling: Scaling, actions: int, settings: DexSettings, seed: int) -> None:
        self.settings = settings
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.actor = Network(scaling, actions, hidden=settings.hidden)
            self.critic = Network(scaling, 1, extra=actions, hidden=settings.hidden)
        self.actor_target, self.critic_target = map(copy.deepcopy, (self.actor, self.critic))
        self._guide = copy.deepcopy(self.actor).requires_grad_(False)
        self._updates = 0
        self._actor_optimiser = adam(self.actor, settings.actor_rate)
        self._imitation_optimiser = adam(self.actor, settings.actor_rate)
        self._critic_optimiser = adam(self.critic, settings.critic_rate)

    def act(self, obs: AnyFloatArray, goal: AnyFloatArray) -> FloatArray:
        """Actions (N, k) in [-1, 1] without exploration."""
        x = torch.from_numpy(np.concatenate([obs, goal], axis=1).astype(np.float32))
        with torch.no_grad():
            action: FloatArray = torch.tanh(self.actor(x)).numpy().astype(np.float64)
        return action

    def imitate(self, demo: Batch, corrected: Batch, rate: float) -> float:
        """One step towards demonstrated actions; returns the mean squared error."""
        for group in self._imitation_optimiser.param_groups:
            group["lr"] = rate
        both = Pair.of(self.actor, demo, corrected)
        loss = squared_distance(torch.tanh(self.actor.head(both.x)), both.action).mean()
        descend(self._imitation_optimiser, loss)
        for copied in (self.actor_target, self._guide):
            follow(copied, self.actor, 1.0)
        return float(loss.detach())

    def update(self, online: Batch, demo: Batch) -> dict[str, float]:
        """One step of critic and actor on two batches of the same length."""
        both = Pair.of(self.actor, online, demo)
        critic_loss = self.critic_loss(both)
        descend(self._critic_optimiser, critic_loss)
        follow(self.critic_target, self.critic, self.settings.tau)
        line = {"critic": float(critic_loss.detach())}
        self._updates += 1
        if self._updates > self.settings.critic_first:
            actor_loss = self.actor_loss(both)
            descend(self._actor_optimiser, actor_loss)
            follow(self.actor_target, self.actor, self.settings.tau)
            line["actor"] = float(actor_loss.detach())
        return line

    def critic_loss(self, both: Pair) -> torch.Tensor:
        """Sum of the mean squared errors of both halves against one-step targets."""
        s = self.settings
        with torch.no_grad():
            wished = self._wished(both.half, both.next_x, both.next_action)
            a = torch.tanh(self.actor_target.head(both.next_x))
            q = value(self.critic_target, both.next_x, a)
            y = both.reward + s.discount * q - s.closeness * squared_distance(wished, a)
            y = y.clamp(-s.closeness / (1 - s.discount), 0.0)
        return 2.0 * ((value(self.critic, both.x, both.action) - y) ** 2).mean()

    def actor_loss(self, both: Pair) -> torch.Tensor:
        """Value forgone, distance from the demonstrations, size of the actions; both halves."""
        with torch.no_grad():
            wished = self._wished(both.half, both.x, both.action)
        a = torch.tanh(self.actor.head(both.x))
        with frozen(self.critic):
            q = value(self.critic, both.x, a)
        away = self.settings.closeness * squared_distance(a, wished)
        return 2.0 * ((away - q).mean() + (a**2).mean())

    def _wished(self, half: int, x: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        """What would have been demonstrated in these states, for these goals.

        The imitating policy is asked about all of them: the action that was recorded is not what it
        would do for a goal in hindsight.
        """
        if self.settings.guidance == "imitation":
            return torch.tanh(self._guide.head(x))
        demo = x[half:], action[half:]
        advice = propagated_action(x[:half], *demo, self.settings.neighbours)
        return torch.cat([advice, action[half:]])

    def state(self) -> dict[str, Any]:
        """Everything that learning goes on from."""
        return {
            "actor": state_of(self.actor, self._actor_optimiser),
            "critic": state_of(self.critic, self._critic_optimiser),
            "actor_target": state_of(self.actor_target),
            "critic_target": state_of(self.critic_target),
            "guide": state_of(self._guide),
            "imitation": state_of(self.actor, self._imitation_optimiser),
            "updates": self._updates,
        }

    def restore(self, tree: dict[str, Any]) -> None:
        """Takes over what `state` gave."""
        restore(tree["actor"], self.actor, self._actor_optimiser)
        restore(tree["critic"], self.critic, self._critic_optimiser)
        restore(tree["actor_target"], self.actor_target)
        restore(tree["critic_target"], self.critic_target)
        restore(tree["guide"], self._guide)
        restore(tree["imitation"], self.actor, self._imitation_optimiser)
        self._updates = tree["updates"]


def value(critic: Network, features: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """Q of features (N, f) and actions (N, a), as (N,)."""
    q: torch.Tensor = critic.head(torch.cat([features, action], dim=1))[:, 0]
    return q


@dataclass(frozen=True, slots=True)
class Pair:
    """Experience and, behind it, as many demonstrated transitions; features and tensors.

    Attributes:
        half: length of each.
    """

    half: int
    x: torch.Tensor
    next_x: torch.Tensor
    action: torch.Tensor
    next_action: torch.Tensor
    reward: torch.Tensor

    @classmethod
    def of(cls, network: Network, online: Batch, demo: Batch) -> Pair:
        """Both batches, with the features that `network` computes."""

        def rows(name: str) -> Float32Array:
            return np.concatenate([getattr(online, name), getattr(demo, name)])

        goal = rows("goal")
        return cls(
            len(online.reward),
            _inputs(network, rows("obs"), goal),
            _inputs(network, rows("next_obs"), goal),
            *(torch.from_numpy(rows(n)) for n in ("action", "next_action", "reward")),
        )


def _inputs(network: Network, obs: Float32Array, goal: Float32Array) -> torch.Tensor:
    with torch.no_grad():
        return network.features(torch.from_numpy(np.concatenate([obs, goal], axis=1)))
