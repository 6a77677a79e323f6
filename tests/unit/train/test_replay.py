import numpy as np
import pytest

from viskill_deploy.train.replay import Episodes, Replay

STEPS = 6


def reached(achieved: np.ndarray, goal: np.ndarray) -> np.ndarray:
    return np.abs(achieved - goal).sum(axis=-1) < 0.5


def episodes(count: int, first: int = 0) -> Episodes:
    """Episode e achieves 100 e + t at step t; its goal is -1, never achieved."""
    number = np.arange(first, first + count, dtype=np.float32)[:, None]
    t = np.arange(STEPS + 1, dtype=np.float32)[None]
    achieved = (100 * number + t)[..., None]
    obs = np.concatenate([achieved, np.repeat(t[..., None], count, axis=0)], axis=-1)
    return Episodes(obs, achieved, np.full((count, 1), -1.0, np.float32), achieved[:, :-1] + 0.5)


def held(count: int = 8, capacity: int = 8) -> Replay:
    memory = Replay(capacity, reached)
    memory.add(episodes(count), np.random.default_rng(0))
    return memory


def test_without_hindsight_goals_stay_and_nothing_is_reached() -> None:
    batch = held().sample(500, 0.0, np.random.default_rng(1))
    assert (batch.goal == -1.0).all()
    assert (batch.reward == -1.0).all()


def test_a_hindsight_goal_was_achieved_later_in_the_same_episode() -> None:
    batch = held().sample(2000, 1.0, np.random.default_rng(1))
    now, goal = batch.obs[:, 0], batch.goal[:, 0]
    assert (goal > now).all()
    assert (goal // 100 == now // 100).all()
    assert ((goal - now) <= STEPS - batch.obs[:, 1]).all()
    assert (goal % 100 == STEPS).any()


def test_the_reward_is_recomputed_for_the_new_goal() -> None:
    batch = held().sample(2000, 1.0, np.random.default_rng(1))
    expected = np.where(batch.goal[:, 0] == batch.next_obs[:, 0], 0.0, -1.0)
    assert (batch.reward == expected).all()
    assert 0.1 < (batch.reward == 0.0).mean() < 0.6


def test_eight_of_ten_goals_are_hindsight() -> None:
    batch = held().sample(5000, 0.8, np.random.default_rng(1))
    assert (batch.goal != -1.0).mean() == pytest.approx(0.8, abs=0.03)


def test_next_state_and_next_action_follow() -> None:
    batch = held().sample(500, 0.5, np.random.default_rng(2))
    assert (batch.next_obs[:, 0] == batch.obs[:, 0] + 1).all()
    assert (batch.action[:, 0] == batch.obs[:, 0] + 0.5).all()
    assert (batch.next_action[:, 0] == batch.obs[:, 0] + 1.5).all()
    assert (batch.last == (batch.obs[:, 1] == STEPS - 2)).all()


def test_a_full_memory_overwrites_at_random_and_keeps_its_size() -> None:
    memory = held(8, capacity=8)
    memory.add(episodes(3, first=50), np.random.default_rng(3))
    assert len(memory) == 8
    numbers = memory.state()["obs"][:, 0, 0] // 100
    assert (numbers >= 50).sum() == 3


def test_a_memory_goes_on_from_its_state() -> None:
    memory, other = held(), Replay(8, reached)
    other.restore(memory.state())
    a, b = (m.sample(50, 0.8, np.random.default_rng(4)) for m in (memory, other))
    assert (a.goal == b.goal).all()
    assert (a.obs == b.obs).all()
