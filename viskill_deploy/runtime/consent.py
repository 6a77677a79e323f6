"""How a session gets the operator's consent: it says what it waits for, and a person answers.

The answer itself comes with the driver's inputs (S22), as a rising edge; nothing here can stand in
for it on real arms.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from viskill_deploy.drivers.base import Driver
from viskill_deploy.safety.supervisor import Supervisor

PATIENCE_S = 60.0
"""Time that a person gets to find the pedal."""

PRESS = "press the consent pedal and keep it pressed: the arms are about to move"
LET_GO = "take your foot off the consent pedal"


class Consent(Protocol):
    """Who lets the arms move.

    Attributes:
        patience_s: how long they may take to do what is wanted, s.
    """

    patience_s: float

    def clear(self, gate: Supervisor, now: float) -> None:
        """Before arming: clears what an earlier motion has latched, where that is theirs to do."""
        ...

    def want(self, agreed: bool) -> None:
        """The session waits for consent to be withdrawn, or to be given."""
        ...


class SimulatedConsent:
    """The loopback's operator: agrees at once, and clears what an episode has latched.

    Args:
        driver: of the simulated cell.
    """

    patience_s = 0.0

    def __init__(self, driver: Driver) -> None:
        self._driver = driver

    def clear(self, gate: Supervisor, now: float) -> None:
        """A new episode is a new start."""
        gate.reset(now)
        gate.disarm()

    def want(self, agreed: bool) -> None:
        """Says it."""
        self._driver.say(consent=agreed)


class PersonsConsent:
    """A person at the robot. On a simulated cell its operator does what the person is asked to.

    Args:
        driver: what brings the person's word.
        tell: shows a person a line.
        has_pedal: a simulated cell has a pedal of its own, on which nobody but a person steps.
    """

    def __init__(
        self,
        driver: Driver,
        tell: Callable[[str], None] = lambda note: None,
        has_pedal: bool = False,
    ) -> None:
        self._driver, self._tell = driver, tell
        self._is_simulated = driver.capabilities.simulated and not has_pedal
        self.patience_s = 0.0 if self._is_simulated else PATIENCE_S

    def clear(self, gate: Supervisor, now: float) -> None:
        """Nothing: what is latched ends the run."""

    def want(self, agreed: bool) -> None:
        """Tells the person what to do."""
        self._tell(PRESS if agreed else LET_GO)
        if self._is_simulated:
            self._driver.say(consent=agreed)


class NodesConsent:
    """A person at an input node, who lets a simulated cell move.

    Args:
        tell: shows a person a line.
    """

    patience_s = PATIENCE_S

    def __init__(self, tell: Callable[[str], None]) -> None:
        self._tell = tell

    def clear(self, gate: Supervisor, now: float) -> None:
        """A new episode is a new start."""
        gate.reset(now)
        gate.disarm()

    def want(self, agreed: bool) -> None:
        """Tells the person what to do."""
        self._tell(PRESS if agreed else LET_GO)


def consent_of(driver: Driver) -> Consent:
    """Who agrees where nobody else is named."""
    return SimulatedConsent(driver) if driver.capabilities.simulated else PersonsConsent(driver)
