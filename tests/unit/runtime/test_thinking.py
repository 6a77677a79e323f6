"""A policy that thinks against the clock: the control loop goes on, and a late one is stopped."""

import threading
from collections.abc import Iterator

import numpy as np
import pytest

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import BundleError, SafetyStop
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.motion.resolve import waypoint_at
from viskill_deploy.motion.waypoints import ActionSpec, apply_action
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.moves import axes_of, run_motion
from viskill_deploy.runtime.session import Session
from viskill_deploy.runtime.thinking import decide
from viskill_deploy.sim.tasks.base import load_task

CELL = load_cell("bipegtransfer")


class Nothing:
    """A recorder that keeps nothing."""

    alive = True

    def cycle(self, *args: object) -> None:
        pass

    def scene(self, *args: object) -> None:
        pass

    def mark(self, *args: object) -> None:
        pass


@pytest.fixture
def session() -> Iterator[Session]:
    """Both arms at the end of a segment, still moving at about 40 mm/s."""
    driver = LoopbackDriver(CELL)
    driver.connect()
    driver.reset(load_task("bipegtransfer").sample_layout(np.random.default_rng(0), "reference"))
    made = Session(CELL, driver, Line(CELL, driver.period_s), Nothing())
    first = waypoint_at(CELL, axes_of(made.make_ready()))
    made.begin()
    away = np.array([0.7, -0.3, -0.4, 0.0, -1.0] * 2)
    made.go_to(apply_action(first, away, first.T_task_tip, CELL, ActionSpec()))
    assert run_motion(made)
    yield made
    driver.close()


def unstepped(session: Session) -> None:
    """Makes the session believe that time goes on by itself."""
    capabilities = session.driver.capabilities
    session.driver.capabilities = type(capabilities)(True, False, True, True)


def test_in_stepped_time_the_answer_comes_at_once_and_nothing_moves(session: Session) -> None:
    before = session.driver.clock.now()
    assert decide(session, lambda: 42) == 42
    assert session.driver.clock.now() == before


def test_against_the_clock_cycles_go_on_while_the_policy_thinks(session: Session) -> None:
    unstepped(session)
    enough, before = threading.Event(), session.driver.clock.now()

    def think() -> int:
        enough.wait(10)
        return 42

    cycles, go_on = 0, session.cycle

    def counted() -> bool:
        nonlocal cycles
        cycles += 1
        if cycles == 10:
            enough.set()
        return go_on()

    session.cycle = counted  # type: ignore[method-assign]
    assert decide(session, think) == 42
    assert cycles >= 10
    assert session.driver.clock.now() > before


def test_a_hung_policy_finds_the_arms_at_rest_and_the_run_stopped(session: Session) -> None:
    unstepped(session)
    never = threading.Event()
    with pytest.raises(SafetyStop, match="thinking"):
        decide(session, lambda: never.wait(30))
    assert session.cause == "S19"
    session.come_to_rest()
    never.set()


def test_an_error_of_the_policy_reaches_the_caller(session: Session) -> None:
    unstepped(session)

    def fail() -> None:
        raise BundleError("here", "broken")

    with pytest.raises(BundleError, match="broken"):
        decide(session, fail)
