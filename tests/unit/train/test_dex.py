"""Every loss against values computed by hand in numpy."""

import numpy as np
import pytest
import torch

from viskill_deploy.sim.tasks import load_task
from viskill_deploy.train.dex import Dex, DexSettings, Pair, propagated_action
from viskill_deploy.train.network import Network, scaling_of
from viskill_deploy.train.replay import Batch

TASK = load_task("bipegtransfer")
HALF = 16


def batch(seed: int) -> Batch:
    rng = np.random.default_rng(seed)

    def draw(*shape: int) -> np.ndarray:
        return rng.uniform(-0.05, 0.05, shape).astype(np.float32)

    return Batch(
        draw(HALF, 35),
        draw(HALF, 8),
        20 * draw(HALF, 10),
        -rng.integers(0, 2, HALF).astype(np.float32),
        draw(HALF, 35),
        20 * draw(HALF, 10),
        np.zeros(HALF, bool),
    )


def agent(**settings: object) -> Dex:
    return Dex(scaling_of(TASK), 10, DexSettings(hidden=16, **settings), seed=1)  # type: ignore[arg-type]


def forward(network: Network, features: np.ndarray) -> np.ndarray:
    weights, x = network.weights(), features.astype(np.float64)
    for layer in range(4):
        x = x @ weights[f"layers.{layer}.weight"].T.astype(np.float64)
        x = x + weights[f"layers.{layer}.bias"]
        x = np.maximum(x, 0.0) if layer < 3 else x
    return x


def q_of(critic: Network, x: np.ndarray, a: np.ndarray) -> np.ndarray:
    return forward(critic, np.concatenate([x, a], axis=1))[:, 0]


def by_hand(
    dex: Dex, both: Pair, wished: np.ndarray, wished_next: np.ndarray
) -> tuple[float, float]:
    s = dex.settings
    x, next_x = both.x.numpy(), both.next_x.numpy()
    a = both.action.numpy()
    pi = np.tanh(forward(dex.actor_target, next_x))
    y = both.reward.numpy() + s.discount * q_of(dex.critic_target, next_x, pi)
    y = y - s.closeness * ((wished_next - pi) ** 2).mean(axis=1)
    y = np.clip(y, -s.closeness / (1 - s.discount), 0.0)
    errors = (q_of(dex.critic, x, a) - y) ** 2
    critic = errors[:HALF].mean() + errors[HALF:].mean()
    pi = np.tanh(forward(dex.actor, x))
    terms = s.closeness * ((wished - pi) ** 2).mean(axis=1) - q_of(dex.critic, x, pi)
    actor = sum(
        (terms[h] + 0).mean() + (pi[h] ** 2).mean() for h in (slice(HALF), slice(HALF, None))
    )
    return critic, actor


def test_losses_with_the_nearest_demonstrations_as_guides() -> None:
    dex = agent(guidance="neighbours", neighbours=3)
    both = Pair.of(dex.actor, batch(1), batch(2))

    def advice(x: torch.Tensor, actions: torch.Tensor) -> np.ndarray:
        states, demos = x[:HALF].numpy(), x[HALF:].numpy()
        rows = []
        for state in states:
            distance = np.sqrt(((demos - state) ** 2).sum(axis=1))
            near = np.argsort(distance)[:3]
            weight = np.exp(-np.sqrt(distance[near]))
            rows.append((weight[:, None] * actions[HALF:].numpy()[near]).sum(axis=0) / weight.sum())
        return np.concatenate([rows, actions[HALF:].numpy()])

    critic, actor = by_hand(
        dex, both, advice(both.x, both.action), advice(both.next_x, both.next_action)
    )
    assert float(dex.critic_loss(both).detach()) == pytest.approx(critic, rel=1e-4)
    assert float(dex.actor_loss(both).detach()) == pytest.approx(actor, rel=1e-4)


def test_losses_with_the_imitating_policy_as_guide() -> None:
    dex = agent()
    dex.imitate(batch(3), batch(4), 1e-3)
    guide = dex.actor.weights()
    dex.update(batch(1), batch(2))
    both = Pair.of(dex.actor, batch(1), batch(2))
    answers = Network(scaling_of(TASK), 10, hidden=16)
    answers.load(guide)
    critic, actor = by_hand(
        dex,
        both,
        np.tanh(forward(answers, both.x.numpy())),
        np.tanh(forward(answers, both.next_x.numpy())),
    )
    assert float(dex.critic_loss(both).detach()) == pytest.approx(critic, rel=1e-4)
    assert float(dex.actor_loss(both).detach()) == pytest.approx(actor, rel=1e-4)


def test_a_nearer_demonstration_speaks_louder() -> None:
    states = torch.tensor([[0.0, 0.0]])
    demos = torch.tensor([[0.0, 0.0], [1.0, 0.0], [9.0, 9.0]])
    actions = torch.tensor([[1.0], [-1.0], [5.0]])
    advised = float(propagated_action(states, demos, actions, 2))
    weight = np.exp([0.0, -1.0])
    assert advised == pytest.approx((weight[0] - weight[1]) / weight.sum(), abs=1e-6)


def test_the_actor_waits_for_the_critic() -> None:
    dex = agent(critic_first=3)
    before = dex.actor.weights()["layers.0.weight"]
    for _ in range(3):
        assert "actor" not in dex.update(batch(1), batch(2))
    assert (dex.actor.weights()["layers.0.weight"] == before).all()
    assert "actor" in dex.update(batch(1), batch(2))
    assert (dex.actor.weights()["layers.0.weight"] != before).any()


def test_the_actors_step_leaves_the_critic_alone() -> None:
    dex = agent(critic_first=0)
    both = Pair.of(dex.actor, batch(1), batch(2))
    torch.autograd.backward(dex.actor_loss(both))
    assert all(p.grad is None for p in dex.critic.parameters())


def test_targets_follow_slowly() -> None:
    dex = agent(critic_first=0, tau=0.25)
    old = dex.critic_target.weights()["layers.1.weight"]
    dex.update(batch(1), batch(2))
    new = dex.critic.weights()["layers.1.weight"]
    assert dex.critic_target.weights()["layers.1.weight"] == pytest.approx(
        old + 0.25 * (new - old), abs=1e-6
    )


def test_an_agent_goes_on_from_its_state_bit_for_bit() -> None:
    one, two = agent(critic_first=1), agent(critic_first=1)
    for _ in range(3):
        one.update(batch(1), batch(2))
    two.restore(one.state())
    for dex in (one, two):
        dex.update(batch(5), batch(6))
    for a, b in zip(one.actor.parameters(), two.actor.parameters(), strict=True):
        assert torch.equal(a, b)
