"""When two methods count as told apart, against values computed by hand."""

import math

import pytest
from result_files import result

from viskill_deploy.train.order import Pair, compare, told_order
from viskill_deploy.train.results import Result

TASK = "matchboardpanel"


def runs(method: str, *rates: float) -> list[Result]:
    return [result(TASK, method, seed, rate) for seed, rate in enumerate(rates)]


def pair(first: list[Result], second: list[Result]) -> Pair:
    made = compare("viskill", "tstar", first, second)
    assert made is not None
    return made


def test_differences_are_taken_seed_by_seed() -> None:
    """Both vary by 20 points from seed to seed, their differences by 2."""
    made = pair(runs("viskill", 0.9, 0.7, 0.5), runs("tstar", 0.80, 0.62, 0.40))
    assert made.difference == pytest.approx((0.10 + 0.08 + 0.10) / 3)
    spread = math.sqrt(((0.10 - made.difference) ** 2 * 2 + (0.08 - made.difference) ** 2) / 2 / 3)
    one, other = 211 / 302, 183 / 302
    counted = math.sqrt((one * (1 - one) + other * (1 - other)) / 300)
    assert made.width == pytest.approx(max(4.3027 * spread, 1.95996 * counted), rel=1e-4)
    assert made.verdict == "kept"


def test_one_seed_tells_nothing_about_another() -> None:
    assert pair(runs("viskill", 1.0), runs("tstar", 0.0)).verdict == "alone"
    made = {"viskill": runs("viskill", 1.0), "tstar": runs("tstar", 0.0)}
    assert told_order(TASK, made).startswith(
        "of 1 pairs no pair as in the paper, 0 reversed, 0 too close to tell, 1 of one seed alone."
    )


def test_seeds_that_only_one_of_them_has_run_do_not_count() -> None:
    made = pair(runs("viskill", 1.0, 1.0, 1.0, 0.5, 0.5), runs("tstar", 0.9, 0.9, 0.9))
    assert made.rates == pytest.approx((1.0, 0.9))
    assert made.verdict == "kept"
    assert compare("viskill", "tstar", runs("viskill", 1.0, 0.5)[1:], runs("tstar", 1.0)) is None


@pytest.mark.parametrize(
    ("first", "second", "verdict"),
    [
        ((1.0, 1.0, 1.0), (1.0, 1.0, 1.0), "open"),
        ((1.0, 1.0, 1.0), (1.0, 1.0, 0.99), "open"),
        ((1.0, 1.0), (0.7, 0.7), "kept"),
        ((0.7, 0.7), (1.0, 1.0), "reversed"),
        ((1.0, 1.0), (0.9, 0.5), "open"),
        ((0.0, 0.0), (0.0, 0.0), "open"),
        ((1.0, 1.0, 0.4), (0.7, 0.7, 0.7), "open"),
    ],
)
def test_what_may_be_chance_is_left_open(
    first: tuple[float, ...], second: tuple[float, ...], verdict: str
) -> None:
    assert pair(runs("viskill", *first), runs("tstar", *second)).verdict == verdict


def test_every_pair_and_what_was_not_run_is_told() -> None:
    made = {
        "viskill": runs("viskill", 0.9, 0.9),
        "tstar": runs("tstar", 1.0, 1.0),
        "dex": runs("dex", 0.01, 0.0),
    }
    assert told_order(TASK, made) == (
        "of 3 pairs 2 as in the paper, 1 reversed, 0 too close to tell. "
        "Reversed: ViSkill and T-STAR (90.0 and 100.0 %). Not run: GCBC."
    )
    made = {method: runs(method, 1.0, 1.0) for method in ("viskill", "tstar", "dex")}
    told = told_order(TASK, made)
    assert "Cannot be told apart: ViSkill from T-STAR, DEX; T-STAR from DEX. Not run: GCBC." in told
    assert told_order(TASK, {}) == "cannot be said. Not run: ViSkill, T-STAR, GCBC, DEX."


def test_each_distribution_is_compared_for_itself() -> None:
    made = {
        "viskill": [result(TASK, "viskill", seed, 1.0, wide=0.9) for seed in (0, 1)],
        "tstar": [result(TASK, "tstar", seed, 1.0, wide=0.4) for seed in (0, 1)],
    }
    assert told_order(TASK, made).startswith("of 1 pairs no pair as in the paper")
    assert told_order(TASK, made, "wide").startswith("of 1 pairs 1 as in the paper")
    assert told_order(TASK, made, "elsewhere").startswith("cannot be said")
