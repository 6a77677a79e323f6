"""Arms in FAULT are cleared by a person who types it, and by nothing else."""

from collections.abc import Iterator

import pytest
from operators import Person
from scripted_arms import Room

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import DriverError, Interrupted
from viskill_deploy.drivers.crtk.driver import CrtkDriver, CrtkOptions
from viskill_deploy.drivers.crtk.messages import String
from viskill_deploy.drivers.watch import OwnTime
from viskill_deploy.runtime.checklist import Checklist
from viskill_deploy.runtime.readiness import look_at_robot
from viskill_deploy.runtime.recovering import recover

CELL = load_cell("bipegtransfer")


@pytest.fixture
def room() -> Room:
    return Room()


@pytest.fixture
def driver(room: Room) -> Iterator[CrtkDriver]:
    """Has just connected to an arm that somebody else has left in FAULT."""
    room.arms[0].become("FAULT")
    room.arms[0].say("error", String("PSM1_PID: tracking error, mask 1"))
    made = CrtkDriver(CELL, room.node, CrtkOptions(), OwnTime)
    made.clock = room.clock
    made.connect()
    yield made
    made.close()


def test_a_person_who_types_it_clears_a_fault_and_nothing_is_enabled_by_that(
    room: Room, driver: CrtkDriver
) -> None:
    person = Person(["recover"])
    recover(driver, person)
    assert "PSM1 is in FAULT (PSM1_PID: tracking error, mask 1)" in person.told[0]
    assert "the arms are DISABLED" in person.told[-1]
    assert [arm.state for arm in room.arms] == ["DISABLED", "DISABLED"]
    assert room.arms[0].words == ["disable"]
    driver.enable()


@pytest.mark.parametrize("typed", ["", "y", "yes", "RECOVER", "recover PSM1"])
def test_whatever_else_is_typed_leaves_the_arms_as_they_are(
    room: Room, driver: CrtkDriver, typed: str
) -> None:
    with pytest.raises(Interrupted, match="not cleared"):
        recover(driver, Person([typed]))
    assert room.arms[0].state == "FAULT"
    with pytest.raises(DriverError, match="--recover"):
        driver.enable()
    driver.close()
    assert [arm.words for arm in room.arms] == [[], []]


def test_an_arm_that_stays_in_fault_is_no_recovery(room: Room, driver: CrtkDriver) -> None:
    room.arms[0].is_obedient = False
    with pytest.raises(DriverError, match='does not follow "disable"'):
        recover(driver, Person(["recover"]))
    with pytest.raises(DriverError, match="a person has to look"):
        driver.enable()


def test_without_a_fault_nobody_is_asked(room: Room, driver: CrtkDriver) -> None:
    recover(driver, Person(["recover"]))
    person = Person()
    recover(driver, person)
    assert person.asked == []
    assert "nothing to clear" in person.told[0]


def test_a_robot_that_has_no_such_way_says_so() -> None:
    with pytest.raises(DriverError, match="--recover is for arms over CRTK"):
        recover(None, Person())


def test_the_preflight_refuses_arms_in_fault_and_says_how_to_clear_it(driver: CrtkDriver) -> None:
    checklist = Checklist()
    look_at_robot(checklist, driver, CELL)
    (power,) = [line for line in checklist.lines if line.name == "power"]
    assert power.status == "fail"
    assert "start again with --recover" in power.text
