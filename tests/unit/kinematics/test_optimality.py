"""The conditions by which an answer is judged, one by one."""

from __future__ import annotations

import math

import numpy as np
import pytest

from viskill_deploy.core.errors import IkError
from viskill_deploy.kinematics.optimality import check_rows, is_free_minimum, onto_box, optimality


def test_a_free_joint_with_no_slope_is_optimal() -> None:
    assert optimality([0.5], [0.0], [0.0], [1.0]) == (0.0, (0,))


@pytest.mark.parametrize(("x", "slope", "held"), [(0.0, 3.0, -1), (1.0, -3.0, 1)])
def test_a_bound_may_be_pushed_against(x: float, slope: float, held: int) -> None:
    assert optimality([x], [slope], [0.0], [1.0]) == (0.0, (held,))


@pytest.mark.parametrize(("x", "slope"), [(0.0, -3.0), (1.0, 3.0), (0.5, 3.0), (0.5, -3.0)])
def test_a_slope_that_leads_inwards_is_a_violation(x: float, slope: float) -> None:
    assert optimality([x], [slope], [0.0], [1.0]) == (3.0, (0,))


def test_a_joint_without_room_is_right_whatever_the_slope() -> None:
    assert optimality([0.5], [3.0], [0.5], [0.5])[0] == 0.0
    assert optimality([0.5], [-3.0], [0.5], [0.5])[0] == 0.0


def test_the_worst_joint_is_reported() -> None:
    worst, _ = optimality([0.5, 0.5, 0.5], [1.0, -2.0, 0.5], [0.0] * 3, [1.0] * 3)
    assert worst == 2.0


def test_what_lies_in_the_box_is_left_as_it_is() -> None:
    assert onto_box([0.0, 0.5, 1.0], [0.0] * 3, [1.0] * 3) == [0.0, 0.5, 1.0]


@pytest.mark.parametrize(
    ("x", "slope", "free"),
    [
        (0.5, 0.0, True),
        (1.0, 0.0, True),
        (0.5, 1e-3, False),
        (0.5, -1e-3, False),
        (1.1, 0.0, False),
        (-0.1, 0.0, False),
        (math.nan, 0.0, False),
        (0.5, math.nan, False),
    ],
)
def test_a_free_minimum_lies_in_the_box_and_has_no_slope(
    x: float, slope: float, free: bool
) -> None:
    assert is_free_minimum([0.5, x], [0.0, slope], [0.0] * 2, [1.0] * 2) is free


def test_what_is_out_by_rounding_is_put_on_the_bound() -> None:
    assert onto_box([-1e-7, 1.0 + 1e-7], [0.0] * 2, [1.0] * 2) == [0.0, 1.0]


@pytest.mark.parametrize(
    ("x", "cause"), [(1.1, "outside-box"), (-0.1, "outside-box"), (math.nan, "not-finite")]
)
def test_what_is_out_by_more_is_refused(x: float, cause: str) -> None:
    with pytest.raises(IkError) as refusal:
        onto_box([x], [0.0], [1.0])
    assert refusal.value.cause == cause


ROWS = (np.array([[1.0, 0.0]]), np.array([-1.0]), np.array([1.0]))


@pytest.mark.parametrize(("x", "multiplier"), [(1.0, 2.0), (-1.0, -2.0), (0.5, 0.0)])
def test_rows_kept_with_fitting_multipliers_pass(x: float, multiplier: float) -> None:
    check_rows(ROWS, np.array([multiplier]), np.array([x, 0.0]))


@pytest.mark.parametrize(
    ("x", "multiplier", "cause"),
    [
        (1.1, 0.0, "infeasible"),
        (-1.1, 0.0, "infeasible"),
        (math.nan, 0.0, "infeasible"),
        (0.5, 2.0, "residual"),
        (1.0, -2.0, "residual"),
    ],
)
def test_rows_left_or_multipliers_that_push_at_nothing_are_refused(
    x: float, multiplier: float, cause: str
) -> None:
    with pytest.raises(IkError) as refusal:
        check_rows(ROWS, np.array([multiplier]), np.array([x, 0.0]))
    assert refusal.value.cause == cause
