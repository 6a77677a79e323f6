"""The two ways between a gate and a driver: states in, setpoints out, failures reported."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import Action, CellState
from viskill_deploy.drivers.base import Driver
from viskill_deploy.safety.decision import Decision
from viskill_deploy.safety.supervisor import Supervisor

MISSED: Final = 2
"""Cycles whose setpoints may fail to arrive, one after the other, before the rest of them are kept
back. An arm that has heard nothing for longer is at rest where it was: what the gate says by then
would be a leap for it."""


class Delivery:
    """Carries states and setpoints; what fails becomes a fault of the gate (S24), no exception.

    Args:
        driver: the robot.
        gate: is told of failures.

    Attributes:
        trouble: what the driver first complained of since `begin`, in words; "" if it did not.
        missed: cycles whose setpoints have not arrived, one after the other.
    """

    def __init__(self, driver: Driver, gate: Supervisor) -> None:
        self._driver, self._gate = driver, gate
        self.begin()

    def begin(self) -> None:
        """A motion begins: what was before is forgotten."""
        self.trouble, self.missed = "", 0

    def read(self, last: CellState) -> CellState:
        """The newest state; `last` with the watchdog's newest word when the driver fails."""
        try:
            return self._driver.state()
        except DriverError as error:
            now = self._driver.clock.now()
            self._report(error, now)
            return replace(last, inputs=self._driver.watch.told(last.inputs, now))

    def send(self, decision: Decision, now: float) -> None:
        """Sends what the gate decided; an emergency stop takes the power away, come what may."""
        if decision.action is Action.ESTOP:
            self._try(self._driver.disable, now)
        if self.missed > MISSED:
            self._try(self._driver.hold, now)
        elif self._try(lambda: self._driver.servo_jp(decision.setpoints), now):
            self.missed = 0
        else:
            self.missed += 1

    def _try(self, call: Callable[[], None], now: float) -> bool:
        """Whether the driver did it."""
        try:
            call()
        except DriverError as error:
            self._report(error, now)
            return False
        return True

    def _report(self, error: DriverError, now: float) -> None:
        """A rule has a number only; people need the driver's sentence too."""
        self.trouble = self.trouble or str(error)
        self._gate.report_fault("S24", now)
