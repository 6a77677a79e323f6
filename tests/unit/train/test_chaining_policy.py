"""Value targets at every border and the losses of chaining, against values computed by hand."""

import numpy as np
import pytest
import torch

from viskill_deploy.sim.tasks import load_task
from viskill_deploy.train.chain_learning import Memory
from viskill_deploy.train.chaining import Chaining, ChainSettings, Transitions
from viskill_deploy.train.methods.viskill_sr import SubtaskChaining
from viskill_deploy.train.rollout import TaskEpisodes

TASK = load_task("bipegtransfer")
COUNT = 32


def transitions(seed: int = 0) -> Transitions:
    rng = np.random.default_rng(seed)

    def draw(*shape: int) -> np.ndarray:
        return rng.uniform(-0.05, 0.05, shape).astype(np.float32)

    def coin() -> np.ndarray:
        return rng.integers(0, 2, COUNT).astype(np.float32)

    return Transitions(
        draw(COUNT, 35),
        draw(COUNT, 3),
        draw(COUNT, 6),
        draw(COUNT, 35),
        draw(COUNT, 6),
        coin(),
        coin(),
        coin(),
    )


def chaining(kind: type[Chaining] = Chaining, **settings: object) -> Chaining:
    return kind(TASK, ChainSettings(hidden=16, **settings), seed=2)  # type: ignore[arg-type]


def sigmoid(x: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-x))


def probabilities(agent: Chaining, pair: tuple[torch.nn.Module, ...], *parts: np.ndarray) -> list:
    x = torch.from_numpy(np.concatenate(parts, axis=1).astype(np.float32))
    with torch.no_grad():
        return [sigmoid(network(x)[:, 0].numpy()) for network in pair]


@pytest.mark.parametrize("index", [1, 2])
def test_the_last_two_skills_learn_the_raw_outcome(index: int) -> None:
    batch = transitions()
    assert (chaining().value_target(index, batch).numpy() == batch.outcome).all()


def test_an_earlier_skill_learns_the_next_ones_value_of_its_own_choice() -> None:
    agent, batch = chaining(), transitions()
    state = agent.noise.bit_generator.state
    target = agent.value_target(0, batch).numpy()
    agent.noise.bit_generator.state = state
    chosen = agent.choose(1, batch.next_obs, batch.task_goal, agent.noise)
    both = probabilities(agent, agent.targets[1], batch.next_obs, batch.task_goal, chosen)
    later = np.mean(both, axis=0)
    assert target == pytest.approx(np.where(batch.ended > 0, batch.outcome, later), abs=1e-5)
    assert (target[batch.ended == 0] != batch.outcome[batch.ended == 0]).all()


def test_there_is_no_discount_between_skills() -> None:
    agent, batch = chaining(), transitions()
    for network in agent.targets[1]:
        with torch.no_grad():
            network.layers[-1].weight.zero_()
            network.layers[-1].bias.fill_(20.0)
    target = agent.value_target(0, batch).numpy()
    assert (target[batch.ended == 0] > 0.999).all()


def test_the_value_loss_is_the_cross_entropy_of_both() -> None:
    agent, batch = chaining(), transitions()
    target = np.random.default_rng(1).random(COUNT).astype(np.float32)
    loss = float(agent.value_loss(0, batch, torch.from_numpy(target)).detach())
    both = probabilities(agent, agent.values[0], batch.obs, batch.task_goal, batch.positions)
    wished = sum(-(target * np.log(p) + (1 - target) * np.log(1 - p)).mean() for p in both)
    assert loss == pytest.approx(wished, rel=1e-5)


def test_the_policy_climbs_the_smaller_value_of_its_choice() -> None:
    agent, batch = chaining(), transitions()
    state = agent.noise.bit_generator.state
    loss = float(agent.climb_loss(0, batch).detach())
    agent.noise.bit_generator.state = state
    chosen = agent.choose(0, batch.obs, batch.task_goal, agent.noise)
    both = probabilities(agent, agent.values[0], batch.obs, batch.task_goal, chosen)
    assert loss == pytest.approx(-np.minimum(*both).mean(), rel=1e-4)


def test_self_imitation_weighs_log_densities_by_advantage() -> None:
    agent, batch = chaining(temperature=0.01), transitions()
    state = agent.noise.bit_generator.state
    loss = float(agent.imitation_loss(0, batch).detach())
    agent.noise.bit_generator.state = state
    chosen = agent.choose(0, batch.obs, batch.task_goal, agent.noise)
    pair = agent.values[0]

    def least(positions: np.ndarray) -> np.ndarray:
        return np.minimum(*probabilities(agent, pair, batch.obs, batch.task_goal, positions))

    advantage = (least(batch.positions) - least(chosen)) / 0.01
    weight = np.exp(advantage - advantage.max())
    weight /= weight.sum()
    policy = agent.policies[0]
    with torch.no_grad():
        x = torch.from_numpy(np.concatenate([batch.obs, batch.task_goal], axis=1))
        mean, log_std = (t.numpy() for t in policy.parameters(policy.network.features(x)))
    image = np.clip((batch.positions - agent.space.centre) / agent.space.half, -0.999, 0.999)
    before = np.arctanh(image)
    density = -0.5 * ((before - mean) / np.exp(log_std)) ** 2 - log_std - 0.5 * np.log(2 * np.pi)
    density = (density - np.log(1 - image**2 + 1e-6)).sum(axis=1)
    assert loss == pytest.approx(-(weight * density).sum(), rel=1e-3)


def test_the_subtask_ablation_looks_no_farther_than_the_next_skill() -> None:
    agent, batch = chaining(SubtaskChaining), transitions()
    for index in (0, 1):
        assert (agent.value_target(index, batch).numpy() == batch.next_reached).all()


def test_without_policy_gradient_only_imitation_is_left() -> None:
    line = chaining(policy_gradient=False).update(0, transitions(), transitions(1))
    assert "climb" not in line
    assert "imitation" in line


def test_positions_that_the_task_overrules_are_valued_as_they_were_given() -> None:
    """MatchBoardPanel's release has no say in where the letter goes."""
    task, rng = load_task("matchboardpanel"), np.random.default_rng(0)
    agent = Chaining(task, ChainSettings(hidden=16), seed=2)
    assert agent.space.free[2].tolist() == [1, 1, 1, 0, 0, 0]
    n = sum(width for _, width in task.observation_layout)

    def draw(*shape: int) -> np.ndarray:
        return rng.uniform(-0.05, 0.05, shape).astype(np.float32)

    zeros = np.zeros(COUNT, np.float32)
    batch = Transitions(
        draw(COUNT, n), draw(COUNT, 3), draw(COUNT, 6), draw(COUNT, n), draw(COUNT, 6), zeros,
        zeros, zeros,
    )  # fmt: skip
    state = agent.noise.bit_generator.state
    target = agent.value_target(1, batch).numpy()
    agent.noise.bit_generator.state = state
    chosen = agent.choose(2, batch.next_obs, batch.task_goal, agent.noise)
    given = np.concatenate([chosen[:, :3], batch.next_positions[:, 3:]], axis=1)
    both = probabilities(agent, agent.targets[2], batch.next_obs, batch.task_goal, given)
    assert target == pytest.approx(np.mean(both, axis=0), abs=1e-5)


def test_values_do_not_learn_from_reached_subgoals_alone() -> None:
    one, two = chaining(), chaining()
    one.update(0, transitions(), transitions(1))
    two.update(0, transitions(), transitions(2))
    for a, b in zip(one.values[0], two.values[0], strict=True):
        for x, y in zip(a.parameters(), b.parameters(), strict=True):
            assert torch.equal(x, y)


def test_values_learn_and_choices_follow_them() -> None:
    """Success wherever the first entry is positive: the policy has to find that out."""
    agent, rng = chaining(rate=3e-3, imitation=0.0), np.random.default_rng(0)
    batch = transitions()
    for _ in range(400):
        positions = rng.uniform(-0.05, 0.05, (COUNT, 6)).astype(np.float32)
        outcome = (positions[:, 0] > 0.0).astype(np.float32)
        agent.update(
            1,
            Transitions(
                batch.obs,
                batch.task_goal,
                positions,
                batch.next_obs,
                positions,
                outcome,
                outcome,
                outcome,
            ),
            None,
        )
    chosen = agent.choose(1, batch.obs, batch.task_goal)
    assert (chosen[:, 0] > 0.0).all()
    assert agent.probability(1, batch.obs, batch.task_goal, chosen).mean() > 0.9


def test_an_agent_goes_on_from_its_state_bit_for_bit() -> None:
    one, two = chaining(), chaining()
    one.update(0, transitions(), transitions(1))
    two.restore(one.state())
    for agent in (one, two):
        agent.update(0, transitions(3), transitions(4))
    for a, b in zip(one.policies, two.policies, strict=True):
        for x, y in zip(a.network.parameters(), b.network.parameters(), strict=True):
            assert torch.equal(x, y)


def episodes(count: int, first: int = 0) -> TaskEpisodes:
    """Episode e: its number stands in every vector; odd ones end after their first skill."""
    number = np.arange(first, first + count, dtype=np.float32)
    odd = number % 2 == 1
    begun = np.stack([np.ones(count, bool), ~odd, ~odd], axis=1)
    return TaskEpisodes(
        np.tile(number[:, None, None], (1, 4, 35)),
        np.tile(number[:, None], (1, 3)),
        np.tile(number[:, None, None], (1, 3, 8)),
        begun,
        begun,
        np.zeros(count, np.int64),
        ~odd,
    )


def test_outcomes_stay_with_their_own_episode() -> None:
    memory = Memory(100)
    memory.add(episodes(10))
    batch = memory.sample(0, 500, np.random.default_rng(0))
    assert batch is not None
    odd = batch.obs[:, 0] % 2 == 1
    assert (batch.positions[:, 0] == batch.obs[:, 0]).all()
    assert (batch.outcome == ~odd).all()
    assert (batch.ended == odd).all()
    second = memory.sample(1, 500, np.random.default_rng(0))
    assert second is not None
    assert (second.obs[:, 0] % 2 == 0).all()


def test_the_oldest_episodes_leave_first() -> None:
    memory = Memory(6)
    memory.add(episodes(4))
    memory.add(episodes(4, first=10))
    batch = memory.sample(0, 500, np.random.default_rng(0))
    assert batch is not None
    assert set(batch.obs[:, 0].tolist()) == {2.0, 3.0, 10.0, 11.0, 12.0, 13.0}
