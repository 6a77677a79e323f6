import math

import coal
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from viskill_deploy.safety.distances import between_segments, segment_to_box, shortened

MILLIMETRES = st.floats(-0.1, 0.1, allow_subnormal=False).map(lambda x: round(x, 4))
POINTS = st.tuples(MILLIMETRES, MILLIMETRES, MILLIMETRES)


def placed(a, b):
    """Rotation to the z axis along a-b, middle and length, for coal's capsules."""
    a, b = np.array(a), np.array(b)
    length = float(np.linalg.norm(b - a))
    z = (b - a) / length if length > 0 else np.array([0.0, 0.0, 1.0])
    x = np.cross(z, np.eye(3)[abs(z).argmin()])
    x /= np.linalg.norm(x)
    return coal.Transform3s(np.column_stack([x, np.cross(z, x), z]), (a + b) / 2), length


def other_distance(shape, T, other, T_other):
    result = coal.DistanceResult()
    return coal.distance(shape, T, other, T_other, coal.DistanceRequest(), result)


@settings(max_examples=300, deadline=None)
@given(POINTS, POINTS, POINTS, POINTS)
def test_segments_are_as_far_apart_as_another_library_says(a, b, c, d):
    (T, one), (T_other, two) = placed(a, b), placed(c, d)
    radius = 1e-3
    expected = other_distance(coal.Capsule(radius, one), T, coal.Capsule(radius, two), T_other)
    ours = between_segments(a, b, c, d) - 2 * radius
    assert ours == pytest.approx(expected, abs=2e-6) or max(ours, expected) < 0.0


@settings(max_examples=200, deadline=None)
@given(POINTS, POINTS, POINTS, POINTS)
def test_a_segment_and_a_box_are_as_far_apart_as_samples_of_it(a, b, c, d):
    lower, upper = tuple(map(min, c, d)), tuple(map(max, c, d))
    t = np.linspace(0.0, 1.0, 2001)[:, None]
    points = np.array(a) + t * (np.array(b) - np.array(a))
    beyond = np.maximum(np.maximum(np.array(lower) - points, points - np.array(upper)), 0.0)
    sampled = float(np.linalg.norm(beyond, axis=1).min())
    ours, step = segment_to_box(a, b, lower, upper), math.dist(a, b) / 2000
    assert sampled - step - 1e-12 <= ours <= sampled + 1e-12


@given(POINTS, POINTS, POINTS, POINTS)
def test_distances_do_not_depend_on_order(a, b, c, d):
    first = between_segments(a, b, c, d)
    for same in [(c, d, a, b), (b, a, c, d), (a, b, d, c)]:
        assert between_segments(*same) == pytest.approx(first, abs=1e-9)
    lower, upper = tuple(map(min, c, d)), tuple(map(max, c, d))
    there, back = segment_to_box(a, b, lower, upper), segment_to_box(b, a, lower, upper)
    assert there == pytest.approx(back, abs=1e-9)


ZERO, X, Y = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)


@pytest.mark.parametrize(
    ("segments", "expected"),
    [
        ((ZERO, X, (0.5, 1.0, 0.0), (0.5, 3.0, 0.0)), 1.0),  # end to middle
        ((ZERO, X, (2.0, 0.0, 0.0), (3.0, 0.0, 0.0)), 1.0),  # one line
        ((ZERO, X, (0.2, 2.0, 0.0), (0.8, 2.0, 0.0)), 2.0),  # parallel, side by side
        ((ZERO, X, (3.0, 2.0, 0.0), (7.0, 2.0, 0.0)), math.sqrt(8.0)),  # parallel, apart
        ((ZERO, X, (7.0, 2.0, 0.0), (3.0, 2.0, 0.0)), math.sqrt(8.0)),
        ((ZERO, ZERO, Y, Y), 1.0),  # two points
        ((ZERO, ZERO, Y, X), math.sqrt(0.5)),  # a point and a segment
        ((Y, X, ZERO, ZERO), math.sqrt(0.5)),
        ((ZERO, X, (0.5, -1.0, 0.3), (0.5, 1.0, 0.3)), 0.3),  # crossing
        ((ZERO, X, (0.5, -1.0, 0.0), (0.5, 1.0, 0.0)), 0.0),
    ],
)
def test_distances_between_segments_known_by_hand(segments, expected):
    assert between_segments(*segments) == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize(
    ("segment", "expected"),
    [
        (((2.0, 0.5, 0.5), (3.0, 0.5, 0.5)), 1.0),  # starts nearest
        (((3.0, 0.5, 0.5), (2.0, 0.5, 0.5)), 1.0),  # ends nearest
        (((3.0, 0.5, 0.5), (3.0, 0.5, 0.5)), 2.0),  # a point
        (((-1.0, 0.5, 2.0), (2.0, 0.5, 2.0)), 1.0),  # over a face
        (((-1.0, 0.5, 0.5), (2.0, 0.5, 0.5)), 0.0),  # through
        (((2.0, 0.0, 0.0), (0.0, 2.0, 0.0)), 0.0),  # touches an edge
        (((3.0, 0.0, 2.0), (0.0, 3.0, 2.0)), math.sqrt(1.5)),  # past an edge
        (((-1.0, 2.0, 2.0), (-2.0, 3.0, 4.0)), math.sqrt(3.0)),  # from a corner away
        (((1.5, 0.5, 0.5), (1.02, 0.5, 0.5)), 0.02),  # ends shortly before a face
        (((1.0, 2.0, 0.5), (0.5, 1.5, 0.5)), 0.5),  # starts over an edge, on a face's plane
    ],
)
def test_distances_to_a_unit_box_known_by_hand(segment, expected):
    assert segment_to_box(*segment, ZERO, (1.0, 1.0, 1.0)) == pytest.approx(expected, abs=1e-15)


def test_a_segment_is_shortened_at_its_end():
    assert shortened(ZERO, X, 0.25) == (0.75, 0.0, 0.0)
    assert shortened(ZERO, X, 0.0) == X
    assert shortened(ZERO, X, 2.0) == ZERO
    assert shortened(X, X, 0.1) == X
    assert shortened(X, X, 0.0) == X
    there = shortened((1.0, 2.0, 3.0), (4.0, 6.0, 15.0), 3.25)
    assert there == pytest.approx((3.25, 5.0, 12.0), abs=1e-12)
