"""Samples of a robot whose clock nobody knows."""

import math
from dataclasses import replace

import pytest

from viskill_deploy.drivers.crtk.messages import NANO, Header, JointState, Time
from viskill_deploy.drivers.crtk.stream import DRIFT, JointStream, SenderClock

START = 1_700_000_000 * NANO
NAMES = ("yaw", "pitch")
GOOD = JointState(Header(Time.of_ns(START)), NAMES, (0.1, 0.2), (0.3, 0.4))


def ns(seconds: float) -> int:
    return START + round(seconds * NANO)


def at(seconds: float, message: JointState = GOOD) -> JointState:
    return replace(message, header=Header(Time.of_ns(ns(seconds))))


def stream(has_velocity: bool = True) -> JointStream:
    made = JointStream("/PSM1/measured_js", NAMES, has_velocity)
    made.hear(at(0.0), 50.0)
    return made


def test_the_quickest_sample_counts_as_having_come_at_once_and_others_are_as_late_as_they_were():
    clock = SenderClock()
    assert clock.time_of(ns(0.00), 50.000) == pytest.approx(50.000)
    assert clock.time_of(ns(0.01), 50.013) == pytest.approx(50.010, abs=1e-4)
    assert clock.time_of(ns(0.02), 50.018) == pytest.approx(50.018)  # 2 ms quicker than the first
    assert clock.time_of(ns(0.03), 50.030) == pytest.approx(50.028, abs=1e-4)
    assert clock.time_of(ns(0.04), 50.140) == pytest.approx(50.038, abs=2e-4)


def test_a_sender_whose_clock_is_slower_never_seems_to_fall_behind():
    clock = SenderClock()
    for step in range(200_000):  # half an hour
        now = 50.0 + 0.01 * step
        stamp = clock.time_of(ns(0.01 * step * (1.0 - 0.9 * DRIFT)), now)
        assert stamp is not None
        assert abs(now - stamp) < 1e-4


def test_a_sample_as_old_as_the_last_one_or_a_little_older_is_none():
    clock = SenderClock()
    clock.time_of(ns(1.0), 50.0)
    assert clock.time_of(ns(1.0), 50.001) is None
    assert clock.time_of(ns(0.901), 50.002) is None
    assert clock.restarts == 0
    assert clock.time_of(ns(1.01), 50.01) == pytest.approx(50.01, abs=1e-4)


def test_a_clock_that_is_set_back_by_more_than_a_tenth_of_a_second_is_learned_anew():
    clock = SenderClock()
    clock.time_of(ns(3600.0), 50.0)
    assert clock.time_of(ns(0.0), 50.01) == pytest.approx(50.01)
    assert clock.restarts == 1
    assert clock.time_of(ns(0.01), 50.03) == pytest.approx(50.02, abs=1e-4)


def test_a_clock_that_is_set_forward_makes_no_sample_older_or_newer_than_it_came():
    clock = SenderClock()
    clock.time_of(ns(0.0), 50.0)
    assert clock.time_of(ns(3600.0), 50.01) == pytest.approx(50.01)


def test_a_good_sample_is_taken_as_it_is():
    newest = stream().newest
    assert (newest.position, newest.velocity) == ((0.1, 0.2), (0.3, 0.4))
    assert newest.is_valid
    assert newest.stamp_s == pytest.approx(50.0)


def test_a_stamp_of_zero_is_no_data_and_does_not_make_the_last_sample_younger():
    made = stream()
    made.hear(replace(GOOD, header=Header()), 50.5)
    assert not made.newest.is_valid
    assert made.newest.stamp_s == pytest.approx(50.0)
    assert made.newest.position == (0.1, 0.2)
    made.hear(at(0.51), 50.51)
    assert made.newest.is_valid


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("field", ["position", "velocity"])
def test_a_number_that_is_none_is_handed_on_for_the_gate_to_see_but_not_vouched_for(
    field: str, bad: float
):
    made = stream()
    made.hear(at(0.01, replace(GOOD, **{field: (0.1, bad)})), 50.01)
    assert not made.newest.is_valid
    assert not math.isfinite(getattr(made.newest, field)[1])


@pytest.mark.parametrize(
    ("spoilt", "why"),
    [
        (replace(GOOD, name=("pitch", "yaw")), "pitch, yaw and not yaw, pitch"),
        (replace(GOOD, name=()), "no names"),
        (replace(GOOD, position=(0.1,)), "1 positions and 2 velocities for 2 joints"),
        (replace(GOOD, position=(0.1, 0.2, 0.3)), "3 positions"),
        (replace(GOOD, velocity=(0.1,)), "2 positions and 1 velocities"),
        (replace(GOOD, velocity=()), "0 velocities"),
    ],
)
def test_a_sample_of_other_joints_is_named_and_changes_no_number(spoilt: JointState, why: str):
    made = stream()
    made.hear(at(0.01, spoilt), 50.01)
    assert not made.newest.is_valid
    assert why in made.newest.misfit
    assert "/PSM1/measured_js" in made.newest.misfit
    assert (made.newest.position, made.newest.stamp_s) == ((0.1, 0.2), pytest.approx(50.0))
    made.hear(at(0.02), 50.02)
    assert made.newest.misfit == ""


def test_a_setpoint_needs_no_velocity():
    made = stream(has_velocity=False)
    made.hear(at(0.01, replace(GOOD, velocity=())), 50.01)
    assert made.newest.is_valid
    assert made.newest.velocity == (0.0, 0.0)
