"""Joints at the moment of a stamp come from the states before it, as they come."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from viskill_deploy.calibrate.collect import PARABOLA_S, STALE_S, _moving_at
from viskill_deploy.core.types import CellState
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.sim.tasks.base import load_task
from viskill_deploy.sim.world import WorldOptions

PLACE, SPEED, ACCELERATION = (np.arange(1.0, 7.0) * scale for scale in (0.1, -0.05, 0.4))


@pytest.fixture(scope="module")
def state() -> CellState:
    task = load_task("bipegtransfer")
    driver = LoopbackDriver(task.cell, WorldOptions(0.01))
    driver.connect()
    driver.reset(task.sample_layout(np.random.default_rng(0), "reference"))
    return driver.state()


def _way(state: CellState, times: Sequence[float]) -> list[CellState]:
    """States of an arm on a parabola whose reported speeds are wrong."""
    states = []
    for t in times:
        jp = PLACE + t * SPEED + t * t / 2 * ACCELERATION
        arm = replace(state.arms[0], stamp_s=t, measured_jp=tuple(jp.tolist()))
        states.append(replace(state, arms=(arm, *state.arms[1:])))
    return states


@pytest.mark.parametrize("rate", [80.0, 100.0, 250.0, 1000.0])
@pytest.mark.parametrize("age", [0.0, 0.02, STALE_S])
def test_a_stamp_of_any_age_finds_its_place_speed_and_acceleration(
    state: CellState, rate: float, age: float
) -> None:
    times = np.arange(0.0, STALE_S + PARABOLA_S + 2.0 / rate, 1.0 / rate)
    stamp = float(times[-1]) - age
    found = _moving_at(_way(state, times.tolist()), 0, stamp)
    assert found is not None
    wanted = (PLACE + stamp * SPEED + stamp**2 / 2 * ACCELERATION, SPEED + stamp * ACCELERATION)
    for got, expected in zip(found, (*wanted, ACCELERATION), strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-9)


def test_states_that_are_read_twice_count_once(state: CellState) -> None:
    twice = np.repeat(np.arange(0.0, 0.1, 0.01), 2).tolist()
    found, plain = (_moving_at(_way(state, t), 0, 0.09) for t in (twice, twice[::2]))
    assert found is not None
    assert plain is not None
    np.testing.assert_allclose(np.array(found), np.array(plain), atol=1e-12)
    assert _moving_at(_way(state, [0.0, 0.0, 0.05, 0.05]), 0, 0.05) is None


@pytest.mark.parametrize("times", [[0.06, 0.07, 0.08, 0.09], [0.2, 0.21, 0.22, 0.23, 0.24, 0.25]])
def test_too_little_before_a_stamp_is_no_measurement(state: CellState, times: list[float]) -> None:
    assert _moving_at(_way(state, times), 0, 0.1) is None
