"""What the robot says of itself before it is switched on, and what it is refused for."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from silent_recorder import SilentRecorder

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import DriverError, MotionError, SafetyStop
from viskill_deploy.core.types import CellState, JointSetpoint
from viskill_deploy.drivers.base import Capabilities
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.drivers.watch import OwnTime
from viskill_deploy.runtime.approach import approach_plan
from viskill_deploy.runtime.checklist import Checklist, Line
from viskill_deploy.runtime.line import Line as MotionLine
from viskill_deploy.runtime.readiness import look_at_robot
from viskill_deploy.runtime.session import Session
from viskill_deploy.sim.world import WorldOptions

CELL = load_cell("bipegtransfer")


class Said(LoopbackDriver):
    """The loopback, that says something else of itself."""

    def __init__(self, **changes: Any) -> None:
        super().__init__(CELL, WorldOptions(0.01))
        self.connect()
        self.changes, self.trouble = changes, ""

    def state(self) -> CellState:
        if self.trouble:
            raise DriverError(self.trouble)
        state = super().state()
        inputs = {k: v for k, v in self.changes.items() if k in {"consent", "estop"}}
        arm = {k: v for k, v in self.changes.items() if k not in inputs}
        arms = (state.arms[0], replace(state.arms[1], **arm))
        return replace(state, arms=arms, inputs=replace(state.inputs, **inputs))


def looked(driver: LoopbackDriver) -> Checklist:
    checklist = Checklist()
    look_at_robot(checklist, driver, CELL)
    return checklist


def named(checklist: Checklist, name: str) -> Line:
    return next(line for line in checklist.lines if line.name == name)


def test_arms_that_are_off_are_told_what_will_be_done_to_them() -> None:
    checklist = looked(Said())
    assert checklist.error is None
    assert "PSM2 is DISABLED and will be enabled and homed" in named(checklist, "power").text


@pytest.mark.invariant("S02")
def test_another_instrument_than_the_cells_is_refused_by_name() -> None:
    checklist = looked(Said(tool="bowel_grasper_400127"))
    assert isinstance(checklist.error, DriverError)
    assert "PSM2 holds bowel_grasper_400127, the cell says large_needle_driver_400006" in str(
        checklist.error
    )


def test_an_instrument_that_only_homing_will_tell_is_a_warning() -> None:
    checklist = looked(Said(tool=""))
    assert named(checklist, "instruments").status == "warn"
    assert looked(Said(tool="", is_homed=True)).error is not None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"operating_state": "FAULT"}, "PSM2 is in FAULT"),
        ({"is_busy": True}, "PSM2 is busy"),
        ({"estop": True}, "emergency stop is pressed"),
    ],
)
@pytest.mark.invariant("S23")
def test_arms_that_must_not_be_switched_on_are_refused(changes: dict[str, Any], words: str) -> None:
    checklist = looked(Said(**changes))
    assert words in str(checklist.error)
    assert named(checklist, "power").status == "fail"


@pytest.mark.invariant("S24")
def test_arms_that_somebody_else_commands_are_refused_with_the_drivers_words() -> None:
    driver = Said()
    driver.trouble = "PSM1 is commanded by MTMR; end the teleoperation"
    checklist = looked(driver)
    assert str(checklist.error) == driver.trouble
    assert [line.name for line in checklist.lines] == ["cell", "arms"]


def test_a_pedal_that_is_pressed_already_has_to_be_let_go() -> None:
    assert named(looked(Said(consent=True)), "consent").status == "warn"


@pytest.mark.invariant("S22")
def test_real_arms_take_neither_a_simulated_operator_nor_a_simulated_cell() -> None:
    driver = Said()
    driver.capabilities = Capabilities(False, True, False, False)
    checklist = looked(driver)
    assert named(checklist, "cell").status == "fail"
    assert "name the robot's own cell" in named(checklist, "cell").text
    assert named(checklist, "consent").status == "fail"
    assert "connect a consent pedal" in named(checklist, "consent").text
    session = Session(CELL, driver, MotionLine(CELL, 0.01), SilentRecorder())
    driver.home = driver.enable = lambda: None  # type: ignore[method-assign]
    assert isinstance(driver.watch, OwnTime)
    driver._cell.enable()
    driver._cell.home()
    driver._cell.say(consent=False)
    session._consent.patience_s = 0.0
    session._consent.want = lambda agreed: driver._cell.say(consent=agreed)  # type: ignore
    with pytest.raises(SafetyStop, match="a person has to agree to motion"):
        session.begin()


def session_at(insertion_m: float) -> Session:
    driver = LoopbackDriver(CELL, WorldOptions(0.01))
    driver.connect()
    axes = np.zeros((2, 7))
    axes[:, 2] = insertion_m
    driver.world.place(driver.world.scene(), axes)
    setpoints = [JointSetpoint(tuple(r[:6]), (0.0,) * 6, r[6], 0.0) for r in axes.tolist()]
    driver.cell.restore(driver.world.save(), setpoints)
    session = Session(CELL, driver, MotionLine(CELL, 0.01, speed=0.5), SilentRecorder())
    session.make_ready()
    return session


def test_the_way_to_the_start_pose_was_passed_by_a_gate_as_a_whole_and_ends_there() -> None:
    session = session_at(0.12)
    plan = approach_plan(session, session.driver.state())
    assert plan is not None
    end = np.array([m.p for m in plan.motion.at(plan.motion.duration_s)])
    np.testing.assert_allclose(end, session.driver.world.home, atol=2e-3)
    margins = session.check(plan, session.driver.state())
    assert min(margins.values()) >= 0.0


def test_an_instrument_inside_its_cannula_is_a_persons_business() -> None:
    session = session_at(0.03)
    with pytest.raises(MotionError, match=r"PSM1's instrument ends inside .* insert it by hand"):
        approach_plan(session, session.driver.state())


def test_arms_in_their_start_pose_need_no_way_there() -> None:
    driver = LoopbackDriver(CELL, WorldOptions(0.01))
    driver.connect()
    session = Session(CELL, driver, MotionLine(CELL, 0.01), SilentRecorder())
    assert approach_plan(session, session.make_ready()) is None
    assert math.isclose(driver.period_s, 0.01)
