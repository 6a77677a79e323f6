"""Bounds at their very borders."""

import pytest

from viskill_deploy.safety.envelope import ROUNDING
from viskill_deploy.safety.ranges import Ranges


def test_a_value_at_a_bound_is_inside_and_one_a_rounding_beyond_is_not():
    ranges = Ranges([-1.0, 2.0, 0.0], [1.0, 6.0, 0.5])
    for index, (low, high) in enumerate([(-1.0, 1.0), (2.0, 6.0), (0.0, 0.5)]):
        beyond = (high - low) * ROUNDING
        assert not ranges.is_below(index, low)
        assert not ranges.is_above(index, high)
        assert ranges.is_below(index, low - beyond)
        assert ranges.is_above(index, high + beyond)
        assert not ranges.is_above(index, low - 1.0)
        assert not ranges.is_below(index, high + 1.0)


def test_a_range_of_two_halves_ends_exactly_where_it_says():
    ranges = Ranges([-1.0], [1.0])
    ranges._half, ranges._inverse = [1.0], [1.0]  # without the rounding's width
    assert not ranges.is_below(0, -1.0)
    assert not ranges.is_above(0, 1.0)


def test_the_nearer_bound_is_a_roundings_width_outside_and_of_two_the_upper():
    ranges = Ranges([2.0], [6.0])
    assert ranges.nearest(0, 3.9) == pytest.approx(2.0, rel=1e-6)
    assert ranges.nearest(0, 4.1) == ranges.nearest(0, 4.0) == pytest.approx(6.0, rel=1e-6)
    assert ranges.nearest(0, 3.9) < 2.0
    assert ranges.nearest(0, 4.1) > 6.0


def test_the_farthest_is_told_in_halves_of_its_range():
    ranges = Ranges([-1.0, 2.0], [1.0, 6.0])
    assert ranges.parts((0.5, 5.0, 1e9)) == pytest.approx([0.5, 0.5], rel=1e-6)
    assert ranges.farthest((-0.25, 3.0)) == pytest.approx(0.5, rel=1e-6)
