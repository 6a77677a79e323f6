"""The mode machine: what leads where, what is latched, and who may clear it."""

from __future__ import annotations

import enum
from typing import Final

from viskill_deploy.core.types import Action, Mode


class Clear(enum.Enum):
    """Who ends what an action has begun."""

    WHEN_CLEAR = "when the condition clears"
    ON_OPERATOR = "operator, after a clean while"
    ON_REARM = "operator, and a fresh arm"
    NEVER = "a new process"


CLEARS: Final = {
    Action.PASS: Clear.WHEN_CLEAR,
    Action.WARN: Clear.WHEN_CLEAR,
    Action.SCALE: Clear.WHEN_CLEAR,
    Action.HOLD: Clear.ON_OPERATOR,
    Action.STOP: Clear.ON_REARM,
    Action.FAULT: Clear.ON_REARM,
    Action.ESTOP: Clear.NEVER,
}

LATCHED_MODE: Final = {
    Action.HOLD: Mode.HOLDING,
    Action.STOP: Mode.HOLDING,
    Action.FAULT: Mode.FAULT,
    Action.ESTOP: Mode.ESTOPPED,
}

WAITING: Final = (Mode.OFF, Mode.CONNECTED, Mode.HOMED, Mode.READY)
"""Modes before arming, in order."""


class Modes:
    """The present mode and the worst action that is latched. Every way down needs a person.

    Attributes:
        mode: the present mode.
        latched: worst action that nobody has cleared; PASS when none is.
    """

    __slots__ = ("latched", "mode")

    def __init__(self) -> None:
        self.mode = Mode.OFF
        self.latched = Action.PASS

    def observe(self, is_homed: bool, is_ready: bool) -> None:
        """Before arming, follows the evidence; without it, falls back."""
        if self.mode in WAITING:
            able = Mode.READY if is_ready else Mode.HOMED
            self.mode = able if is_homed else Mode.CONNECTED

    def escalate(self, action: Action) -> None:
        """Latches HOLD or worse; what is latched never gets milder here."""
        worst = max(action, self.latched)
        if worst >= Action.HOLD:
            self.latched, self.mode = worst, LATCHED_MODE[worst]

    def arm(self) -> None:
        """READY → ARMED; the supervisor has seen every pre-check green."""
        if self.mode is Mode.READY:
            self.mode = Mode.ARMED

    def run(self) -> None:
        """ARMED → RUNNING: a first setpoint has passed."""
        if self.mode is Mode.ARMED:
            self.mode = Mode.RUNNING

    def resume(self) -> bool:
        """HOLDING → RUNNING if nothing worse than HOLD is latched; True when it did."""
        if CLEARS[self.latched] is not Clear.ON_OPERATOR:
            return False
        self.latched, self.mode = Action.PASS, Mode.RUNNING
        return True

    def disarm(self) -> bool:
        """ARMED and RUNNING → CONNECTED. True when it did."""
        if self.mode not in (Mode.ARMED, Mode.RUNNING):
            return False
        self.mode = Mode.CONNECTED
        return True

    def reset(self) -> bool:
        """STOP and FAULT → CONNECTED, HOLD too; an emergency stop never. True when it did."""
        if self.latched is Action.PASS or CLEARS[self.latched] is Clear.NEVER:
            return False
        self.latched, self.mode = Action.PASS, Mode.CONNECTED
        return True
