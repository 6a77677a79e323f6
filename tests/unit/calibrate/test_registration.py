from __future__ import annotations

import numpy as np
import pytest
from measured_arm import rotation

from viskill_deploy.calibrate.registration import register, rigid
from viskill_deploy.core.errors import CalibrationError


def _pair(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation(rng.normal(0, 1, 3)), rng.normal(0, 0.1, 3)
    a = rng.uniform(-0.05, 0.05, (n, 3))
    return a, a @ T[:3, :3].T + T[:3, 3], T


@pytest.mark.parametrize("seed", range(5))
def test_exact_pairs_give_the_transform_back(seed: int) -> None:
    a, b, T = _pair(4, seed)
    np.testing.assert_allclose(rigid(a, b), T, atol=1e-12)
    np.testing.assert_allclose(register(a, b).T, T, atol=1e-12)


def test_mirrored_points_still_give_a_rotation() -> None:
    a, b, _ = _pair(20)
    assert np.linalg.det(rigid(a, b * [1, 1, -1])[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize("wrong", [1, 6, 15])
def test_wrong_points_are_found_and_left_out(wrong: int) -> None:
    a, b, T = _pair(40)
    rng = np.random.default_rng(1)
    b = b + rng.normal(0, 1e-4, b.shape)
    b[:wrong] += rng.uniform(0.005, 0.05, (wrong, 3))
    found = register(a, b)
    assert not found.is_inlier[:wrong].any()
    assert found.is_inlier[wrong:].mean() > 0.9
    assert np.linalg.norm(found.T[:3, 3] - T[:3, 3]) < 1e-4
    assert found.rms_m < 3e-4


def test_a_measured_point_may_be_wrong_by_kilometres() -> None:
    a, b, T = _pair(12)
    b[3] = 1e6
    np.testing.assert_allclose(register(a, b).T, T, atol=1e-9)


@pytest.mark.parametrize(
    ("a", "b", "words"),
    [
        (np.zeros((2, 3)), np.zeros((2, 3)), "at least 3"),
        (np.ones((5, 3)), np.zeros((4, 3)), "at least 3"),
        (np.zeros((5, 3)), np.zeros((5, 3)), "one line"),
        (np.outer(np.arange(5), [0.01, 0, 0]), _pair(5)[0], "robot points lie"),
        (_pair(5)[0], np.outer(np.arange(5), [0.01, 0, 0]), "measured points lie"),
        (np.full((5, 3), np.nan), np.zeros((5, 3)), "not finite"),
    ],
)
def test_pairs_that_fix_nothing_are_refused(a: np.ndarray, b: np.ndarray, words: str) -> None:
    with pytest.raises(CalibrationError, match=words):
        register(a, b)
