"""What is against moving dVRK arms: a fault, another commander, another instrument than the cell's.

What is found while setpoints go out stays found until somebody enables the arms anew, and the arms
hold at once. A fault stays until a person has looked at it.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Sequence
from typing import Final

from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.crtk.arm import ArmClient

STREAM_S: Final = 0.25
"""A stream that was not fed for this long has ended: the next setpoint begins another."""

RECOVER: Final = (
    "a person has to look at it, put the cause right, and then clear it: "
    "viskill execute --recover, reset in viskill guard, recover() in code"
)


class Doubts:
    """Looks at all arms of a cell.

    Args:
        arms: the arms.

    Attributes:
        fault: why a person has to look at the arms; "" when nobody has to.
        trouble: what was found while setpoints went out.
    """

    def __init__(self, arms: Sequence[ArmClient]) -> None:
        self._arms, self.fault, self.trouble = arms, "", ""
        self._errors = [0 for _ in arms]  # how many each had reported when the stream began

    def fit(self) -> str:
        """What of the arms' topics is not as the cell says; "" when all fits."""
        return first(arm.misfit() for arm in self._arms)

    def rivals(self) -> str:
        """Who else moves the arms; "" for nobody."""
        return first(arm.rival() for arm in self._arms)

    def standing(self) -> str:
        """What is against moving arms that could be moved; "" for nothing."""
        return first(arm.rival() or arm.strange_tool() for arm in self._arms)

    def silence(self, now: float) -> str:
        """Which topic is lost; "" when all are heard."""
        return first(arm.silence(now) for arm in self._arms)

    def look_for_faults(self) -> str:
        """A fault, which stays; "" for none."""
        self._latch(first(arm.fault() for arm in self._arms))
        return self.fault

    def found(self, now: float) -> str:
        """What is against moving arms that are ready; "" for nothing."""
        if self.look_for_faults() or self.trouble:
            return self.fault or self.trouble
        found = self.standing()
        if self.is_streaming(now):
            self._latch(self._complaint())
            intrusions = [arm.intrusion() for arm in self._arms]
            found = self.trouble = first([found, *intrusions, self.silence(now)])
            if found:
                self._hold()
        return self.fault or found

    def is_streaming(self, now: float) -> bool:
        """Whether setpoints go out."""
        return now - max([arm.sent.last_s for arm in self._arms]) < STREAM_S

    def end_stream(self) -> None:
        """What was sent until now is past."""
        self._errors = [arm.errors for arm in self._arms]
        for arm in self._arms:
            arm.sent.forget()

    def forgive(self) -> None:
        """A person has looked at the arms."""
        self.fault = self.trouble = ""

    def _complaint(self) -> str:
        """An error that an arm has reported since the stream began; "" for none."""
        known = zip(self._arms, self._errors, strict=True)
        return first(f'{arm.name} reports "{arm.error}"' for arm, n in known if arm.errors > n)

    def _latch(self, fault: str) -> None:
        if fault and not self.fault:
            self.fault = f"{fault}; {RECOVER}"
            self._hold()

    def _hold(self) -> None:
        """All arms, whichever it is about: they may have something between them."""
        for arm in self._arms:
            with contextlib.suppress(DriverError):  # the first trouble is the one that counts
                arm.hold()


def first(reasons: Iterable[str]) -> str:
    """The first reason that is one; "" when there is none."""
    return next(filter(None, reasons), "")


def refuse(*reasons: str) -> None:
    """Raises DriverError for the first reason that is one."""
    reason = first(reasons)
    if reason:
        raise DriverError(reason)
