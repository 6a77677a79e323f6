from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.tasks.base import Task, load_task
from viskill_deploy.sim.vector_loop import VectorLoop
from viskill_deploy.train.calibration import SPREADS_M, calibrate, judged, spread_until
from viskill_deploy.train.chain_learning import Chained
from viskill_deploy.train.chaining import Chaining, ChainSettings

TASK = load_task("bipegtransfer")


class Hasty:
    """The task with skills of two steps."""

    skills = tuple(replace(skill, budget=2) for skill in TASK.skills)

    def __getattr__(self, name: str) -> Any:
        return getattr(TASK, name)


@pytest.fixture(scope="module")
def loop() -> VectorLoop:
    return VectorLoop(cast(Task, Hasty()), 2)


def still(obs: FloatArray, goal: FloatArray) -> FloatArray:
    """Moves nothing and keeps the jaws shut."""
    action = np.zeros((len(obs), 10))
    action[:, 4::5] = -1.0
    return action


def test_subgoals_are_moved_up_to_the_skill_in_question_and_by_amounts_in_turn() -> None:
    class Ten:
        count, task = 10, TASK

    spread = spread_until(Ten(), 1, 0, np.random.default_rng(0))  # type: ignore[arg-type]
    assert spread.shape == (10, 3, 6)
    assert not spread[:, 2].any()
    largest = np.abs(spread[:, :2]).max(axis=(1, 2))
    limits = np.tile(SPREADS_M, 2)
    assert (largest <= limits).all()
    assert (largest[limits > 0] > 0.3 * limits[limits > 0]).all()
    assert not largest[limits == 0].any()
    later = spread_until(Ten(), 1, 3, np.random.default_rng(0))  # type: ignore[arg-type]
    assert np.flatnonzero(np.abs(later[:5, 0]).max(axis=1) == 0).tolist() == [2]


def test_the_value_at_a_skills_start_is_compared_with_the_outcome_of_its_episode(
    loop: VectorLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[int, ...]] = []

    begun: list[FloatArray] = []

    class Told(Chaining):
        def choose(self, index: int, obs: FloatArray, *rest: Any) -> FloatArray:
            begun.append(obs)
            return super().choose(index, obs, *rest)

        def probability(self, index: int, *seen: FloatArray) -> FloatArray:
            asked.append((index, *(part.shape[1] for part in seen)))
            assert np.allclose(seen[0], begun[index], atol=1e-6), "the start of this skill"
            return np.array([0.9, 0.2])

    monkeypatch.setattr(VectorLoop, "success", lambda _: np.array([True, False]))
    policy = Chained([still] * 3, Told(TASK, ChainSettings(hidden=8), 0))
    values, outcomes = judged(loop, policy, 1, 2, np.random.default_rng(0))
    assert values.tolist() == [0.9, 0.2]
    assert outcomes.tolist() == [True, False]
    assert asked == [(1, 35, 3, 8)]


def test_calibration_covers_every_skill_and_depends_on_the_seed_alone(loop: VectorLoop) -> None:
    policy = Chained([still] * 3, Chaining(TASK, ChainSettings(hidden=8), 0))
    first, again = (calibrate(loop, policy, 2, seed=7) for _ in range(2))
    assert first == again
    assert list(first.skills) == ["grasp", "handover", "release"]
    assert {part.episodes for part in first.skills.values()} == {2}
    assert first.all.episodes == 6
    assert sum(b.count for b in first.all.bins) == 6
    assert all(not b.success for b in first.all.bins)
