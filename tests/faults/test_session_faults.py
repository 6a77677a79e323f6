"""Faults around the gate: whatever fails, the arms come to rest under jerk-limited setpoints."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import DriverError, SafetyStop
from viskill_deploy.core.types import CellState, Mode, Request
from viskill_deploy.drivers.base import DISABLED
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.motion.resolve import waypoint_at
from viskill_deploy.motion.waypoints import ActionSpec, apply_action
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.moves import axes_of
from viskill_deploy.runtime.session import Session
from viskill_deploy.safety.checked import CheckedSetpoint
from viskill_deploy.sim.tasks.base import load_task

CELL = load_cell("bipegtransfer")
FAULT_AT = 12
"""Cycles after which the fault begins: both arms move at about 40 mm/s then."""


class Notebook:
    """A recorder that can fail."""

    def __init__(self) -> None:
        self.alive = True
        self.modes: list[Mode] = []

    def cycle(self, now: float, state: CellState, request: Request, *rest: object) -> None:
        self.modes.append(rest[3])  # type: ignore[arg-type]

    def scene(self, *args: object) -> None:
        pass

    def mark(self, *args: object) -> None:
        pass


class FaultyDriver(LoopbackDriver):
    """A loopback that does what a test tells it after some cycles."""

    def __init__(self) -> None:
        super().__init__(CELL)
        self.cycles = 0
        self.on_state: Callable[[CellState], CellState] = lambda state: state
        self.on_servo: Callable[[], None] = lambda: None
        self.sent: list[tuple[float, ...]] = []

    @property
    def is_faulty(self) -> bool:
        return self.cycles > FAULT_AT

    def state(self) -> CellState:
        state = super().state()
        return self.on_state(state) if self.is_faulty else state

    def servo_jp(self, setpoints: Sequence[CheckedSetpoint]) -> None:
        self.cycles += 1
        self.sent.append(tuple(x for s in setpoints for x in s.setpoint.jp))
        if self.is_faulty:
            self.on_servo()
        super().servo_jp(setpoints)


def running() -> tuple[Session, FaultyDriver, Notebook]:
    driver, notebook = FaultyDriver(), Notebook()
    driver.connect()
    driver.reset(load_task("bipegtransfer").sample_layout(np.random.default_rng(0), "reference"))
    session = Session(CELL, driver, Line(CELL, driver.period_s), notebook)
    state = session.make_ready()
    session.begin()
    first = waypoint_at(CELL, axes_of(state))
    away = np.array([0.7, -0.3, -0.4, 0.0, -1.0, 0.7, 0.3, -0.4, 0.0, -1.0])
    session.go_to(apply_action(first, away, first.T_task_tip, CELL, ActionSpec()))
    return session, driver, notebook


def run_out(session: Session, driver: FaultyDriver) -> int:
    """Cycles until the gate steps in and the arms are at rest; returns when it stepped in."""
    for cycle in range(200):
        if not session.cycle():
            session.come_to_rest()
            return cycle
    raise AssertionError("the gate never stepped in")


def assert_stopped_smoothly(driver: FaultyDriver) -> None:
    q = np.array(driver.sent)
    limits = np.array([*CELL.arms[0].arm.limit(3), *CELL.arms[1].arm.limit(3)])
    acceleration = np.abs(np.diff(q, n=2, axis=0)) / driver.period_s**2
    assert (acceleration <= limits * 1.001).all()
    assert np.abs(np.diff(q[-2:], axis=0)).max() < 1e-9


def nan_measured(state: CellState) -> CellState:
    arm = state.arms[0]
    bad = replace(arm, measured_jp=(math.nan, *arm.measured_jp[1:]))
    return replace(state, arms=(bad, state.arms[1]))


def silent(state: CellState) -> CellState:
    raise DriverError("the cable is out")


def powered_off(state: CellState) -> CellState:
    return replace(state, arms=tuple(replace(a, operating_state=DISABLED) for a in state.arms))


def somebody_else(state: CellState) -> CellState:
    arm = state.arms[1]
    other = replace(arm, setpoint_jp=(arm.setpoint_jp[0] + 0.1, *arm.setpoint_jp[1:]))
    return replace(state, arms=(state.arms[0], other))


@pytest.mark.parametrize(
    ("fault", "rule", "mode"),
    [
        (nan_measured, "S02", Mode.FAULT),
        (silent, "S24", Mode.FAULT),
        (powered_off, "S23", Mode.FAULT),
        (somebody_else, "S24", Mode.FAULT),
    ],
)
def test_a_fault_in_what_is_measured_stops_both_arms_in_the_same_cycle(
    fault: Callable[[CellState], CellState], rule: str, mode: Mode
) -> None:
    session, driver, notebook = running()
    driver.on_state = fault
    assert run_out(session, driver) == FAULT_AT + 1
    assert session.cause == rule
    assert notebook.modes[-1] is mode
    assert_stopped_smoothly(driver)


def test_a_driver_that_refuses_a_setpoint_is_stopped_in_the_next_cycle() -> None:
    session, driver, _ = running()

    def refuse() -> None:
        driver.on_servo = lambda: None
        raise DriverError("the socket is full")

    driver.on_servo = refuse
    assert run_out(session, driver) == FAULT_AT + 1
    assert session.cause == "S24"
    assert_stopped_smoothly(driver)


def test_what_a_driver_complains_of_is_the_episodes_reason_in_its_own_words() -> None:
    session, driver, _ = running()
    driver.on_state = silent
    while session.cycle():
        pass
    result = EpisodeResult(0)
    session.come_to_rest(result)
    assert (result.stopped_by, result.reason) == ("S24", "the cable is out")
    driver.on_state = lambda state: state
    session.make_ready()
    session.begin()
    assert session.trouble == ""


@pytest.mark.invariant("S32")
def test_a_dead_recorder_stops_the_run() -> None:
    session, driver, notebook = running()
    for _ in range(FAULT_AT):
        assert session.cycle()
    notebook.alive = False
    assert run_out(session, driver) == 0
    assert session.cause == "S32"
    assert_stopped_smoothly(driver)


def test_the_emergency_stop_takes_the_power_away() -> None:
    session, driver, notebook = running()
    for _ in range(FAULT_AT):
        assert session.cycle()
    driver.say(estop=True)
    assert not session.cycle()
    assert session.cause == "S23"
    assert notebook.modes[-1] is Mode.ESTOPPED
    assert driver.state().arms[0].operating_state == DISABLED


def test_the_power_goes_also_when_the_driver_refuses_everything_else() -> None:
    session, driver, _ = running()

    def refuse() -> None:
        raise DriverError("not ready")

    driver.on_servo = refuse
    driver.say(estop=True)
    driver.cycles = FAULT_AT
    session.cycle()
    assert driver.cell.state(0.0).arms[0].operating_state == DISABLED


@pytest.mark.invariant("S22")
@pytest.mark.parametrize("source", ["simulated", "pedal"])
def test_arms_that_are_real_are_not_armed_on_a_simulated_operators_word(source: str) -> None:
    session, driver, _ = running()
    session.line.fail("the test begins anew")
    run_out(session, driver)
    assert session.gate.reset(0.0) is Mode.CONNECTED
    driver.capabilities, driver.cycles = replace(driver.capabilities, simulated=False), FAULT_AT + 1
    session.make_ready()
    words = iter(range(10**6))

    def pedal(state: CellState) -> CellState:
        """Let go for ten readings, then pressed."""
        inputs = replace(state.inputs, consent=next(words) >= 10, consent_source=source)
        return replace(state, inputs=inputs)

    driver.on_state = pedal
    if source == "simulated":
        with pytest.raises(SafetyStop, match="a person has to agree"):
            session.begin()
        assert session.gate.mode is not Mode.ARMED
    else:
        session.begin()
        assert session.gate.mode is Mode.ARMED


@pytest.mark.invariant("S22")
def test_an_operator_who_lets_go_holds_the_arms_in_the_same_cycle() -> None:
    session, driver, notebook = running()
    for _ in range(FAULT_AT):
        assert session.cycle()
    driver.say(consent=False)
    assert run_out(session, driver) == 0
    assert session.cause == "S22"
    assert notebook.modes[-1] is Mode.HOLDING
    assert_stopped_smoothly(driver)


@pytest.mark.invariant("S31", "S23")
def test_nobody_arms_again_after_an_emergency_stop_in_this_process() -> None:
    session, driver, _ = running()
    driver.say(estop=True)
    assert not session.cycle()
    driver.say(estop=False)
    session.make_ready()
    with pytest.raises(SafetyStop):
        session.begin()


def test_a_fault_is_cleared_by_the_operator_and_armed_afresh() -> None:
    session, driver, _ = running()
    driver.on_state = nan_measured
    run_out(session, driver)
    assert session.gate.mode is Mode.FAULT
    driver.on_state = lambda state: state
    session.make_ready()
    session.begin()
    assert session.gate.mode is Mode.ARMED
    assert session.cycle()


def test_an_operator_who_wants_to_stop_is_heard_within_a_cycle() -> None:
    session, driver, _ = running()
    for _ in range(FAULT_AT):
        assert session.cycle()
    session.ask_to_stop()
    session.cycle()
    assert not session.cycle()
    session.come_to_rest()
    assert session.cause == "S16"
    assert_stopped_smoothly(driver)


def test_a_line_without_solution_is_a_stop_not_an_exception() -> None:
    session, driver, notebook = running()
    for _ in range(FAULT_AT):
        assert session.cycle()
    session.line.fail("the policy answered with NaN")
    run_out(session, driver)
    assert session.cause == "S16"
    assert notebook.modes[-1] in {Mode.HOLDING, Mode.FAULT}
    assert_stopped_smoothly(driver)


def test_an_exception_or_ctrl_c_brings_the_arms_to_rest_before_the_driver_closes() -> None:
    session, driver, _ = running()
    with pytest.raises(KeyboardInterrupt), session:
        for _ in range(FAULT_AT):
            session.cycle()
        raise KeyboardInterrupt
    assert_stopped_smoothly(driver)
    assert len(driver.sent) > FAULT_AT
    with pytest.raises(DriverError, match="connect"):
        driver.state()


def test_a_late_policy_is_stopped_when_the_next_waypoint_is_overdue() -> None:
    session, driver, _ = running()
    stepped_in = run_out(session, driver)
    assert session.cause == "S19"
    assert stepped_in > FAULT_AT
    assert_stopped_smoothly(driver)
