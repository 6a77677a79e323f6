"""What is looked at on the robot before it is switched on. Nothing is sent here."""

from __future__ import annotations

from functools import partial

from viskill_deploy.core.calibration_files import insist_real
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DriverError, SafetyStop
from viskill_deploy.core.types import ArmState, CellState
from viskill_deploy.drivers.base import ENABLED, Driver
from viskill_deploy.runtime.checklist import Checklist, Found
from viskill_deploy.runtime.session import SIMULATED

FAULTY = "FAULT"


def look_at_robot(checklist: Checklist, driver: Driver, cell: CellDescription) -> CellState | None:
    """Adds a line for everything that the robot says of itself.

    Returns:
        What it says; None when it says nothing, or somebody else is in charge of it.
    """
    checklist.look("cell", "", partial(_cell, driver, cell))
    state = checklist.look("arms", "S24", partial(_arms, driver))
    if state is not None:
        checklist.look("instruments", "S02", partial(_instruments, cell, state))
        checklist.look("power", "S23", partial(_power, state))
        checklist.look("consent", "S22", partial(_consent, driver, state))
    return state


def _cell(driver: Driver, cell: CellDescription) -> Found[None]:
    if driver.capabilities.simulated:
        return Found(None, "simulated: no real arm moves")
    insist_real(cell)
    return Found(None, ", ".join(f"{arm.name} {arm.entry.serial}" for arm in cell.arms))


def _arms(driver: Driver) -> Found[CellState]:
    """Arms that are heard, and that nobody else commands: a driver says so when asked for them."""
    state = driver.state()
    return Found(state, ", ".join(arm.name for arm in state.arms) + " are heard")


def _instruments(cell: CellDescription, state: CellState) -> Found[None]:
    wanted = {arm.name: arm.arm.tool for arm in cell.arms}
    unknown = [arm.name for arm in state.arms if not arm.tool and not arm.is_homed]
    for arm in state.arms:
        if arm.tool != wanted[arm.name] and arm.name not in unknown:
            raise DriverError(
                f"{arm.name} holds {arm.tool or 'no instrument'}, the cell says "
                f"{wanted[arm.name]}; change the instrument, or name the right cell with --robot"
            )
    if unknown:
        return Found(None, f"{', '.join(unknown)} will say so when homed", warns=True)
    return Found(None, ", ".join(f"{arm.name}: {arm.tool}" for arm in state.arms))


def _power(state: CellState) -> Found[None]:
    if state.inputs.estop:
        raise SafetyStop("the emergency stop is pressed; release it, then start again")
    for arm in state.arms:
        if arm.operating_state == FAULTY:
            raise DriverError(
                f"{arm.name} is in FAULT; look at it, put the cause right, and start again with "
                "--recover (over CRTK), or clear it at its console"
            )
        if arm.is_busy:
            raise DriverError(f"{arm.name} is busy; put that right at its console, start again")
    return Found(None, ", ".join(f"{arm.name} {_will_be(arm)}" for arm in state.arms))


def _will_be(arm: ArmState) -> str:
    if arm.operating_state == ENABLED and arm.is_homed:
        return "is enabled and homed"
    todo = ["homed"] if arm.operating_state == ENABLED else ["enabled", "homed"]
    return f"is {arm.operating_state} and will be {' and '.join(todo)}"


def _consent(driver: Driver, state: CellState) -> Found[None]:
    inputs, is_real = state.inputs, not driver.capabilities.simulated
    if is_real and inputs.consent_source == SIMULATED:
        raise SafetyStop("the operator is simulated and the arms are not; connect a consent pedal")
    if inputs.consent:
        return Found(None, f"{inputs.consent_source} is pressed already: let go of it", warns=True)
    return Found(None, f"by {inputs.consent_source or 'a person'}, not pressed")
