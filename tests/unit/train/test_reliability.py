import numpy as np
import pytest

from viskill_deploy.train.reliability import pooled, reliability


def test_values_that_come_true_have_no_error() -> None:
    values = np.repeat([0.25, 0.75], 400)
    outcomes = np.concatenate([np.arange(400) < 100, np.arange(400) < 300])
    judged = reliability(values, outcomes)
    assert judged.error == pytest.approx(0.0)
    assert [b.count for b in judged.bins if b.count] == [400, 400]


def test_the_error_is_the_gap_of_each_bin_weighted_by_its_episodes() -> None:
    values = np.array([0.05] * 30 + [0.95] * 10)  # gaps 0.05 and 0.45
    outcomes = np.array([False] * 30 + [True] * 5 + [False] * 5)
    assert reliability(values, outcomes).error == pytest.approx((30 * 0.05 + 10 * 0.45) / 40)


def test_values_that_are_always_too_high_by_a_tenth_are_found_out() -> None:
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.0, 0.9, 200_000)
    judged = reliability(truth + 0.1, rng.random(200_000) < truth)
    assert judged.error == pytest.approx(0.1, abs=0.005)


def test_borders_belong_to_the_upper_bin_and_one_to_the_last() -> None:
    judged = reliability(np.array([0.0, 0.1, 1.0]), np.array([False, True, True]))
    assert [b.count for b in judged.bins] == [1, 1, 0, 0, 0, 0, 0, 0, 0, 1]
    assert {name: b.count for name, b in judged.groups.items()} == {
        "low": 2,
        "middle": 0,
        "high": 1,
    }


def test_groups_tell_how_often_low_middle_and_high_values_succeed() -> None:
    values = np.array([0.1, 0.2, 0.5, 0.5, 0.9, 0.7])
    outcomes = np.array([False, False, True, False, True, True])
    groups = reliability(values, outcomes).groups
    assert [g.success for g in groups.values()] == [0.0, 0.5, 1.0]
    assert groups["low"].value == pytest.approx(0.15)


def test_no_episodes_have_no_error() -> None:
    judged = reliability(np.empty(0), np.empty(0, bool))
    assert judged.error is None
    assert judged.groups["high"].success is None


def test_pooling_is_comparing_together() -> None:
    rng = np.random.default_rng(1)
    values, outcomes = rng.random(500), rng.random(500) < 0.5
    parts = [reliability(values[:130], outcomes[:130]), reliability(values[130:], outcomes[130:])]
    whole, joined = reliability(values, outcomes), pooled(parts)
    assert joined.episodes == 500
    assert joined.error == pytest.approx(whole.error)
    for one, other in zip(joined.bins, whole.bins, strict=True):
        assert one.count == other.count
        assert one.value == pytest.approx(other.value)
        assert one.success == pytest.approx(other.success)
