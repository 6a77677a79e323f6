"""The velocity box: what it promises for one step, and for ever."""

from __future__ import annotations

import math

import numpy as np
import pytest

from viskill_deploy.core.description import load_robot
from viskill_deploy.core.errors import IkError
from viskill_deploy.kinematics.limits import JointLimits

ONE = JointLimits((-1.0,), (1.0,), (2.0,), (10.0,))
DT = 0.004


def box(q: float, v: float, limits: JointLimits = ONE) -> tuple[float, float]:
    """Bounds of a one-joint arm."""
    lower, upper = limits.velocity_box([q], [v], DT)
    return lower[0], upper[0]


def test_far_from_everything_acceleration_bounds_the_change() -> None:
    assert box(0.0, 0.5) == pytest.approx((0.46, 0.54))


def test_near_the_speed_limit_the_speed_bounds_it() -> None:
    assert box(0.0, 1.99) == pytest.approx((1.95, 2.0))
    assert box(0.0, -1.99) == pytest.approx((-2.0, -1.95))


def test_at_a_limit_the_box_ends_at_standstill() -> None:
    assert box(1.0, 0.0) == pytest.approx((-0.04, 0.0))
    assert box(-1.0, 0.0) == pytest.approx((0.0, 0.04))


def test_outside_a_limit_only_the_way_back_is_left() -> None:
    lower, upper = box(1.2, 0.0)
    assert lower == upper == pytest.approx(-0.04)
    lower, upper = box(-1.2, 0.0)
    assert lower == upper == pytest.approx(0.04)


def test_driven_at_a_limit_as_hard_as_the_box_allows_the_joint_stops_inside_it() -> None:
    for sign in (1.0, -1.0):
        q, v = 0.0, 0.0
        for _ in range(1000):
            lower, upper = box(q, v)
            assert lower <= upper
            v = upper if sign > 0 else lower
            q += v * DT
            assert abs(q) <= 1.0 + 1e-12
        assert abs(q) == pytest.approx(1.0, abs=1e-6)


def test_from_any_state_that_can_stop_the_box_is_never_empty() -> None:
    rng = np.random.default_rng(0)
    q, v = 0.0, 0.0
    for _ in range(20_000):
        lower, upper = box(q, v)
        assert lower <= upper
        v = rng.choice([lower, upper, rng.uniform(lower, upper)])
        q += v * DT
    assert abs(q) <= 1.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_joint_too_fast_for_its_room_is_refused(sign: float) -> None:
    with pytest.raises(IkError, match="cannot stop before its limit") as refusal:
        box(sign * 0.9999, sign * 1.5)
    assert refusal.value.cause == "infeasible"


def test_a_joint_that_has_to_brake_fully_is_given_full_braking() -> None:
    lower, upper = box(0.99, 0.6)
    assert lower == upper == pytest.approx(0.56)
    lower, upper = box(-0.99, -0.6)
    assert lower == upper == pytest.approx(-0.56)


@pytest.mark.parametrize("v", [2.1, -2.1])
def test_a_velocity_over_its_limit_is_refused(v: float) -> None:
    with pytest.raises(IkError, match="over its limit") as refusal:
        box(0.0, v)
    assert refusal.value.cause == "infeasible"


def test_the_speed_near_a_limit_is_the_one_that_fills_the_room() -> None:
    for room in (1e-4, 0.01, 0.1):
        v = box(1.0 - room, math.sqrt(20.0 * room) - 0.02)[1]
        assert v * DT + v * v / 20.0 == pytest.approx(room)


def test_a_joint_without_end_stops_is_bounded_by_speed_alone() -> None:
    free = JointLimits((-math.inf,), (math.inf,), (2.0,), (10.0,))
    assert box(100.0, 0.0, free) == pytest.approx((-0.04, 0.04))


@pytest.mark.parametrize(
    ("columns", "cause"),
    [
        (((1.0,), (0.0,), (1.0,), (1.0,)), "bad-bounds"),
        (((math.nan,), (0.0,), (1.0,), (1.0,)), "not-finite"),
        (((0.0,), (1.0,), (0.0,), (1.0,)), "bad-bounds"),
        (((0.0,), (1.0,), (1.0,), (math.inf,)), "bad-bounds"),
        (((0.0,), (1.0, 2.0), (1.0,), (1.0,)), "bad-bounds"),
    ],
)
def test_limits_that_make_no_sense_are_refused(
    columns: tuple[tuple[float, ...], ...], cause: str
) -> None:
    with pytest.raises(IkError) as refusal:
        JointLimits(*columns)
    assert refusal.value.cause == cause


def test_a_plans_limits_lie_inside_the_gates() -> None:
    arm = load_robot("psm_classic", "large_needle_driver_400006")
    limits = JointLimits.planning(arm)
    assert limits.lower[0] == pytest.approx(arm.limit(0)[0] + arm.gate.position_margin_rad)
    assert limits.upper[2] == pytest.approx(arm.limit(1)[2] - arm.gate.position_margin_m)
    assert limits.lower[2] > arm.insertion_min_m
    assert all(v < full for v, full in zip(limits.velocity, arm.limit(2), strict=True))
    assert all(a < full for a, full in zip(limits.acceleration, arm.limit(3), strict=True))
