"""What a session tells its watchdog, and what it does about what the watchdog says."""

import threading
import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from test_session_faults import CELL, FaultyDriver, Notebook, assert_stopped_smoothly, run_out

from viskill_deploy.core import realtime
from viskill_deploy.core.errors import DriverError, SafetyStop
from viskill_deploy.core.types import CellState, Inputs, Mode, Verdict
from viskill_deploy.drivers.base import DISABLED
from viskill_deploy.motion.resolve import waypoint_at
from viskill_deploy.motion.waypoints import ActionSpec, apply_action
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.moves import axes_of
from viskill_deploy.runtime.session import Session
from viskill_deploy.runtime.thinking import think_while_held
from viskill_deploy.safety.supervisor import Supervisor
from viskill_deploy.sim.tasks.base import load_task

pytestmark = pytest.mark.invariant("S25", "S26")


class Listener:
    """A watch that notes what it is told and says what a test wants."""

    def __init__(self) -> None:
        self.beats: list[float] = []
        self.is_released = True
        self.lost_at: float | None = None
        self.has_stepped_in = False

    def beat(self, now: float) -> None:
        self.beats.append(now)
        self.is_released = False

    def release(self) -> None:
        self.is_released = True

    def told(self, inputs: Inputs, now: float) -> Inputs:
        stamp = now if self.lost_at is None else self.lost_at
        return replace(inputs, watchdog_stamp_s=stamp, watchdog_stepped_in=self.has_stepped_in)

    def close(self) -> None:
        pass


def moving(stepped: bool = True) -> tuple[Session, FaultyDriver, Listener]:
    driver, listener = FaultyDriver(), Listener()
    driver.capabilities = replace(driver.capabilities, stepped=stepped)
    driver.watch = listener
    driver.connect()
    driver.reset(load_task("bipegtransfer").sample_layout(np.random.default_rng(0), "reference"))
    session = Session(CELL, driver, Line(CELL, driver.period_s), Notebook())
    state = session.make_ready()
    session.begin()
    assert listener.is_released
    assert listener.beats == []
    first = waypoint_at(CELL, axes_of(state))
    away = np.array([0.7, -0.3, -0.4, 0.0, -1.0, 0.7, 0.3, -0.4, 0.0, -1.0])
    session.go_to(apply_action(first, away, first.T_task_tip, CELL, ActionSpec()), last=True)
    for _ in range(10):
        assert session.cycle()
    return session, driver, listener


def test_the_heart_beats_in_every_cycle_until_the_arms_are_at_rest() -> None:
    session, driver, listener = moving()
    while not session.line.arrived:
        assert session.cycle()
        assert not listener.is_released
    session.finish()
    assert listener.is_released
    assert np.diff(listener.beats).max() == pytest.approx(driver.period_s)
    assert len(listener.beats) == driver.cycles


def test_the_heart_beats_while_the_gate_stops_the_arms() -> None:
    session, driver, listener = moving()
    session.line.fail("on purpose")
    run_out(session, driver)
    assert np.diff(listener.beats).max() == pytest.approx(driver.period_s)
    assert listener.is_released


def test_arms_that_do_not_come_to_rest_are_left_to_the_watchdog(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It hears no beat from then on, and was not told to expect none."""
    session, _, listener = moving()
    monkeypatch.setattr("viskill_deploy.runtime.session.STOP_S", 0.02)
    session.line.fail("on purpose")
    session.come_to_rest()
    beats = len(listener.beats)
    assert session.gate.mode is Mode.HOLDING
    assert not listener.is_released
    for _ in range(5):
        session.cycle()
    assert len(listener.beats) == beats


def test_arms_that_are_held_are_looked_at_while_a_long_plan_is_made_and_go_on_after_it() -> None:
    """Against the clock. Nobody waits for a heartbeat meanwhile: a plan makes looks late."""
    session, driver, listener = moving(stepped=False)
    driver.say(consent=False)
    while session.cycle():
        pass
    session.come_to_rest()
    driver.say(consent=True)
    beats, until = len(listener.beats), driver.cycles + round(2.0 / driver.period_s)

    def plan() -> str:
        while driver.cycles < until:
            time.sleep(0.001)
        return "a plan"

    assert think_while_held(session, plan) == "a plan"
    assert listener.is_released
    assert len(listener.beats) == beats
    assert session.resume() == ()
    session.cycle()
    assert not listener.is_released
    session.settle()


def test_nobody_waits_for_a_plan_once_it_came_to_more_than_a_hold() -> None:
    session, driver, _ = moving(stepped=False)
    driver.say(consent=False)
    while session.cycle():
        pass
    session.come_to_rest()
    assert session.is_held
    ended = threading.Event()
    with pytest.raises(SafetyStop, match="before there was a plan"):  # 2 s without consent: STOP
        think_while_held(session, ended.wait)
    ended.set()
    assert not session.is_held
    session.settle()


def test_without_a_watchdog_the_run_ends() -> None:
    session, driver, listener = moving()
    listener.lost_at = driver.clock.now()
    cycles = run_out(session, driver)
    assert cycles * driver.period_s == pytest.approx(0.05, abs=2 * driver.period_s)
    assert session.cause == "S26"
    assert session.gate.mode is Mode.HOLDING
    assert_stopped_smoothly(driver)


def test_a_cell_that_nobody_watches_is_not_armed() -> None:
    session, driver, listener = moving()
    session.settle()
    listener.lost_at = driver.clock.now() - 1.0
    session.make_ready()
    with pytest.raises(SafetyStop, match="S26"):
        session.begin()


def test_a_watchdog_that_has_stepped_in_is_the_cause_whatever_else_is_wrong() -> None:
    session, driver, listener = moving()
    listener.has_stepped_in = True
    driver.cell.disable()  # S23 too
    assert not session.cycle()
    assert session.cause == "S25"
    assert session.gate.mode is Mode.ESTOPPED
    assert driver.state().arms[0].operating_state == DISABLED


def test_a_watchdog_that_has_stepped_in_is_heard_when_the_driver_is_not() -> None:
    session, driver, listener = moving()

    def silent(state: CellState) -> CellState:
        raise DriverError("the cable is out")

    driver.on_state, driver.cycles = silent, 1000
    listener.has_stepped_in = True
    assert not session.cycle()
    assert session.gate.mode is Mode.ESTOPPED


def test_a_driver_in_real_time_without_a_watchdog_is_refused() -> None:
    driver = FaultyDriver()
    driver.capabilities = replace(driver.capabilities, stepped=False)
    with pytest.raises(DriverError, match="watchdog"):
        Session(CELL, driver, Line(CELL, driver.period_s), Notebook())


def test_memory_is_locked_before_power_and_real_time_is_given_back_at_rest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It may take a quarter of a second, in which the feedback grows old."""
    done: list[str] = []
    for name in ("settle", "prepare", "pause", "release"):
        monkeypatch.setattr(realtime, name, partial(done.append, name))
    arm = Supervisor.arm

    def armed(gate: Supervisor, state: CellState, now: float) -> tuple[Verdict, ...]:
        done.append("arm")
        return arm(gate, state, now)

    monkeypatch.setattr(Supervisor, "arm", armed)
    session, _, listener = moving(stepped=False)
    assert done == ["settle", "prepare", "arm"]
    session.settle()
    assert done == ["settle", "prepare", "arm", "pause"]
    listener.has_stepped_in = True
    session.make_ready()
    with pytest.raises(SafetyStop, match="S25"):
        session.begin()
    assert done == ["settle", "prepare", "arm", "pause"] * 2
    session.__exit__(None, None, None)
    assert done[-1] == "release"
