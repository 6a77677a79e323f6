"""How the chaining policies' own subgoals are moved while they learn."""

from types import SimpleNamespace

import numpy as np

from viskill_deploy.train.chain_learning import ChainAmounts, ChainLearner

COUNT, SKILLS = 4000, 4


def moves(share: float) -> np.ndarray:
    free = np.ones((SKILLS, 6))
    free[-1] = free[1, 3:] = 0.0
    learner = SimpleNamespace(
        loop=SimpleNamespace(count=COUNT, task=SimpleNamespace(skills=("",) * SKILLS)),
        amounts=ChainAmounts(spread_share=share, spread_m=0.04),
        chaining=SimpleNamespace(space=SimpleNamespace(free=free)),
        _rng=np.random.default_rng(0),
    )
    return ChainLearner._spread(learner)  # type: ignore[arg-type]


def test_the_subgoals_of_one_skill_or_of_some_in_a_row_are_moved() -> None:
    spread = moves(1.0)
    assert spread.shape == (COUNT, SKILLS, 6)
    is_moved = spread.any(axis=2)
    assert not is_moved[:, -1].any()  # the last skill's is the task's own
    assert not spread[:, 1, 3:].any()  # nor what the policy does not choose
    rows = {tuple(row) for row in is_moved[:, :-1].astype(int).tolist()}
    assert rows == {(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (0, 1, 1), (1, 1, 1)}
    assert 0.039 < np.abs(spread).max() <= 0.04


def test_a_share_of_the_episodes_is_left_as_it_is() -> None:
    share = moves(0.25).any(axis=(1, 2)).mean()
    assert abs(share - 0.25) < 0.03
    assert not moves(0.0).any()
