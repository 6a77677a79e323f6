"""Whatever goes wrong with dVRK arms: what the gate does, when, and what a person is told.

The arms are the simulated ones, stepped; faults are theirs. Both arms move at 40 mm/s when it
begins.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from silent_recorder import SilentRecorder

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import Mode
from viskill_deploy.drivers.base import DISABLED, ENABLED
from viskill_deploy.drivers.crtk.messages import StringStamped
from viskill_deploy.drivers.crtk.server_options import ServerOptions
from viskill_deploy.drivers.crtk.simulated import SteppedCrtk
from viskill_deploy.drivers.crtk.topics import Version
from viskill_deploy.motion.resolve import waypoint_at
from viskill_deploy.motion.waypoints import ActionSpec, apply_action
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.moves import axes_of
from viskill_deploy.runtime.session import Session
from viskill_deploy.sim.tasks.base import load_task

CELL = load_cell("bipegtransfer")
LAYOUT = load_task("bipegtransfer").sample_layout(np.random.default_rng(0), "reference")
AWAY = np.array([0.7, -0.3, -0.4, 0.0, -1.0, 0.7, 0.3, -0.4, 0.0, -1.0])
FAULT_AT = 12
"""Cycles after which the fault begins."""


class Run:
    """A session whose arms are on their way."""

    def __init__(self, version: Version = "2.4") -> None:
        self.driver = SteppedCrtk(CELL, server=ServerOptions(version=version, homing="stay"))
        self.driver.connect()
        self.driver.reset(LAYOUT)
        line = Line(CELL, self.driver.period_s)
        self.session = Session(CELL, self.driver, line, SilentRecorder())
        self.go()

    def go(self) -> None:
        """The arms are sent on their way."""
        state = self.session.make_ready()
        self.session.begin()
        first = waypoint_at(CELL, axes_of(state))
        self.session.go_to(apply_action(first, AWAY, first.T_task_tip, CELL, ActionSpec()))
        for _ in range(FAULT_AT):
            assert self.session.cycle()
        self.began = self.driver.clock.now()

    def noticed_s(self) -> float:
        """How long the gate takes to step in."""
        while self.session.cycle():
            assert self.driver.clock.now() < self.began + 1.0, "the gate never stepped in"
        return self.driver.clock.now() - self.driver.period_s - self.began

    def ended(self) -> EpisodeResult:
        """The arms are at rest."""
        result = EpisodeResult(0)
        self.session.come_to_rest(result)
        return result

    def speeds(self) -> list[float]:
        """What every arm is really told to do, rad/s or m/s."""
        setpoints = self.driver.front.cell.setpoints
        return [max(map(abs, (*s.jv, s.jaw_v))) for s in setpoints]

    def close(self) -> None:
        self.session.__exit__(None, None, None)


@pytest.fixture
def run() -> Iterator[Run]:
    made = Run()
    yield made
    made.close()


@dataclass(frozen=True)
class Row:
    """A fault, and what has to come of it."""

    fault: str
    rule: str
    mode: Mode
    within_s: float
    said: str


ROWS = [
    Row("tracking", "S23", Mode.FAULT, 0.005, "PSM1 is in FAULT (PSM1: tracking error"),
    Row("potentiometers", "S23", Mode.FAULT, 0.005, "PSM1 is in FAULT (PSM1: inconsistency"),
    Row("current", "S23", Mode.FAULT, 0.005, "PSM1 is in FAULT (PSM1: too many consecutive"),
    Row("amplifiers", "S23", Mode.FAULT, 0.005, "PSM1 is in FAULT (PSM1: hardware error"),
    Row("watchdog", "S23", Mode.FAULT, 0.005, "PSM1 is in FAULT (PSM1: watchdog triggered"),
    Row("power", "S23", Mode.ESTOPPED, 0.010, "PSM1 is in FAULT (PSM1: detected power loss"),
    Row("silence", "S18", Mode.FAULT, 0.060, ""),
    Row("invalid", "S23", Mode.FAULT, 0.015, ""),
    Row("short", "S24", Mode.FAULT, 0.015, "/PSM1/measured_js carries the joints"),
    Row("nan", "S02", Mode.FAULT, 0.015, ""),
    Row("following", "S24", Mode.FAULT, 0.005, "a teleoperation commands PSM1"),
    Row("second commander", "S24", Mode.FAULT, 0.050, "PSM1 holds a setpoint for"),
    Row("clutch", "S24", Mode.FAULT, 0.005, "somebody presses PSM1's clutch"),
    Row("tool", "S24", Mode.FAULT, 0.010, "PSM1 has no instrument"),
    Row("paused", "S23", Mode.FAULT, 0.010, "arms not ready (PSM1 PAUSED)"),
    Row("disabled", "S23", Mode.FAULT, 0.010, "arms not ready (PSM1 DISABLED)"),
]


@pytest.mark.invariant("S02", "S18", "S23", "S24")
@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.fault.replace(" ", "-"))
def test_a_fault_of_one_arm_stops_both_in_its_time_and_is_named(run: Run, row: Row):
    run.driver.front.cause(row.fault, "PSM1", True)
    assert run.noticed_s() <= row.within_s + 1e-9
    assert run.session.cause == row.rule
    result = run.ended()
    assert run.session.gate.mode is row.mode
    assert result.stopped_by == row.rule
    assert row.said in result.reason
    assert run.driver.clock.now() - run.began < 0.5
    run.driver.clock.sleep_until(run.driver.clock.now() + 0.05)
    assert run.speeds() == [0.0, 0.0]


OLD_ROWS = [
    Row("invalid", "S18", Mode.FAULT, 0.060, ""),
    Row("clutch", "S24", Mode.FAULT, 0.005, "somebody presses PSM1's clutch"),
    Row("tracking", "S23", Mode.FAULT, 0.005, "PSM1 is in FAULT"),
]


@pytest.mark.parametrize("row", OLD_ROWS, ids=lambda row: row.fault)
def test_what_dvrk_2_3_says_otherwise_comes_to_the_same(row: Row):
    run = Run("2.3")
    run.driver.front.cause(row.fault, "PSM1", True)
    assert run.noticed_s() <= row.within_s + 1e-9
    result = run.ended()
    assert (result.stopped_by, run.session.gate.mode) == (row.rule, row.mode)
    assert row.said in result.reason
    run.close()


@pytest.mark.invariant("S22")
@pytest.mark.parametrize("is_console_gone", [False, True])
def test_a_pedal_that_is_let_go_or_lost_holds_the_arms(run: Run, is_console_gone: bool):
    line = run.driver.exchange.lines["/console/operator_present"]
    if is_console_gone:
        line.mouths.clear()
    else:
        run.driver.say(consent=False)
    assert run.noticed_s() <= 0.010 + 1e-9
    assert run.ended().stopped_by == "S22"
    assert run.session.gate.mode is Mode.HOLDING
    assert [arm.condition.state for arm in run.driver.arms] == [ENABLED, ENABLED]


def test_after_a_fault_the_arms_go_again_when_a_person_has_looked_and_not_before(run: Run):
    run.driver.front.cause("tracking", "PSM1", True)
    run.noticed_s()
    run.ended()
    for _ in range(2):
        with pytest.raises(DriverError, match="a person has to look"):
            run.session.make_ready()
    run.driver.recover()
    assert {arm.condition.state for arm in run.driver.arms} == {DISABLED}
    run.driver.reset(LAYOUT)
    run.go()
    assert run.session.cycle()


def test_arms_that_get_no_power_are_named_with_what_they_say():
    driver = SteppedCrtk(CELL, server=ServerOptions(homing="stay"))
    driver.connect()
    driver.front.cause("power", "PSM2", True)
    with pytest.raises(DriverError, match=r"PSM2 .*failed to enable power"):
        driver.enable()
    driver.close()


def test_arms_about_which_there_is_doubt_are_paused_before_they_lose_their_power():
    run, words = Run(), list[str]()
    run.driver.exchange.line("/PSM2/state_command", StringStamped).ears.append(
        (run.driver.front._transport, lambda word, now: words.append(word.string))
    )
    run.driver.front.cause("clutch", "PSM1", True)
    run.noticed_s()
    run.ended()
    run.close()
    assert words == ["pause", "disable"]
    assert run.driver.front.arms["PSM2"].arm.operating.state == DISABLED
