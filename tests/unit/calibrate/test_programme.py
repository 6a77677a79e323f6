from __future__ import annotations

import numpy as np
import pytest

from viskill_deploy.calibrate.error_model import ErrorModel
from viskill_deploy.calibrate.measurements import Measurements
from viskill_deploy.calibrate.parameters import NAMES, USUAL, vector_of
from viskill_deploy.calibrate.programme import CLEAR_M, choose_poses, free_box
from viskill_deploy.calibrate.truths import INSERTION_M, draw_truth
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.motion.resolve import task_poses

ARMS = [
    ("bipegtransfer", 0),
    ("bipegtransfer", 1),
    ("bipegboard", 0),
    ("bipegboard", 1),
    ("matchboardpanel", 0),
]


@pytest.mark.parametrize(("name", "index"), ARMS)
def test_poses_lie_in_the_free_part_of_the_workspace(name: str, index: int) -> None:
    cell = load_cell(name)
    arm = cell.arms[index]
    q = choose_poses(cell, index, 25, seed=0)
    tips = task_poses(cell, index, q)[:, :3, 3]
    low, high = free_box(cell, arm)
    assert (low > arm.entry.workspace_lower_m).all()
    assert (high < arm.entry.workspace_upper_m).all()
    assert (tips >= low - 1e-9).all()
    assert (tips <= high + 1e-9).all()
    assert (q > arm.arm.limit(0)).all()
    assert (q < arm.arm.limit(1)).all()
    assert (q[:, 2] > arm.arm.insertion_min_m).all()
    assert len(np.unique(q, axis=0)) == 25


def test_arms_that_nobody_has_calibrated_keep_clear_of_what_stands_on_the_board() -> None:
    cell, rng, count = load_cell("bipegtransfer"), np.random.default_rng(0), 50
    model, q = ErrorModel(cell.arms[0]), choose_poses(cell, 0, count, seed=0)
    lower = []
    for _ in range(400):
        turns = rng.choice([-1.0, 1.0], (count, 3))
        rows = Measurements(np.arange(50.0), q, np.zeros((count, 6)), turns, np.zeros((count, 3)))
        true = model.points(vector_of(draw_truth(rng)), rows)
        lower.append(float((model.points(np.zeros(len(NAMES)), rows) - true)[:, 2].max()))
    assert np.quantile(lower, 0.99) < CLEAR_M
    assert np.quantile(lower, 0.99) > 0.5 * CLEAR_M, "they are wrong by as much as that"


def test_the_same_seed_gives_the_same_programme() -> None:
    cell = load_cell("bipegtransfer")
    first, again = (choose_poses(cell, 0, 10, seed=4) for _ in range(2))
    np.testing.assert_array_equal(first, again)


def test_chosen_poses_tell_more_than_the_first_ones() -> None:
    cell = load_cell("bipegtransfer")
    chosen = choose_poses(cell, 0, 30, seed=1)
    many = choose_poses(cell, 0, 300, seed=1)
    plain = many[np.random.default_rng(0).choice(300, 30, replace=False)]

    def information(q: np.ndarray) -> float:
        turns = np.random.default_rng(0).choice([-1.0, 1.0], (30, 3))
        m = Measurements(np.arange(30.0), q, np.zeros((30, 6)), turns, np.zeros((30, 3)))
        _, J = ErrorModel(cell.arms[0]).linearised(np.zeros(27), m)
        A = J.reshape(-1, len(NAMES)) * USUAL / 5e-4
        return float(np.linalg.slogdet(np.eye(27) + A.T @ A)[1])

    assert information(chosen) > information(plain) + 1.0


def test_more_poses_than_there_is_room_for_are_refused() -> None:
    with pytest.raises(CalibrationError, match="ask for fewer"):
        choose_poses(load_cell("bipegtransfer"), 0, 100000, seed=0)


def test_truths_have_the_sizes_that_they_say() -> None:
    truths = [draw_truth(np.random.default_rng(seed)) for seed in range(300)]
    insertions = np.array([truth.joint_offset[2] for truth in truths])
    assert np.abs(insertions).max() <= INSERTION_M
    assert np.abs(insertions).mean() == pytest.approx(INSERTION_M / 2, rel=0.15)
    moved = np.array([truth.base_translation_m for truth in truths])
    assert moved.std() == pytest.approx(0.004, rel=0.1)
