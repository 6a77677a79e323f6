"""The operating state of one simulated arm: which state command does what, and when.

Source of the table: cisst's prmOperatingState, as dVRK's arms use it.
"""

from __future__ import annotations

from typing import Literal

from viskill_deploy.drivers.base import DISABLED, ENABLED, PAUSED

FAULT = "FAULT"

COMMANDS = ("enable", "disable", "home", "unhome", "pause", "resume")

SUPPORTED: dict[str, frozenset[str]] = {
    DISABLED: frozenset({"enable", "disable", "unhome"}),
    ENABLED: frozenset({"enable", "disable", "home", "unhome", "pause"}),
    PAUSED: frozenset({"disable", "unhome", "pause", "resume"}),
    FAULT: frozenset({"enable", "disable", "unhome"}),
}
"""Which commands a state takes. In FAULT "enable" is taken and does nothing: first "disable"."""

POWERING_S = 0.5
"""A real arm takes about as long until its amplifiers are on."""

POWER_TIMEOUT_S = 6.0
"""An arm whose power has not come by then goes to FAULT."""

ENGAGING_S = 0.5
"""How long an instrument that was put in takes to be engaged; seconds on a real arm."""

Phase = Literal["idle", "powering", "homing", "engaging"]


class Operating:
    """State machine of one arm; it knows nothing of joints.

    Attributes:
        state: "DISABLED", "ENABLED", "PAUSED" or "FAULT".
        is_homed: the arm knows where it is and may be moved.
        has_reference: its encoders have been set since the start: homing needs no motion.
        phase: what takes time at present; the arm is busy meanwhile.
    """

    def __init__(self) -> None:
        self.state, self.is_homed, self.has_reference = DISABLED, False, False
        self.phase: Phase = "idle"
        self._phase_s = 0.0

    @property
    def has_power(self) -> bool:
        """Whether the drives hold the arm; otherwise its brakes do."""
        return self.state in {ENABLED, PAUSED}

    @property
    def is_ready(self) -> bool:
        """Whether motion is accepted."""
        return self.state == ENABLED and self.is_homed and self.phase == "idle"

    def command(self, word: str) -> str:
        """Acts on a state command.

        Returns:
            Why not, in dVRK's words; "" when it was accepted.
        """
        if word not in COMMANDS:
            return f'unknown state command "{word}"'
        if word not in SUPPORTED[self.state]:
            return f'command "{word}" is not supported in state {self.state}'
        match word:
            case "enable" if self.state == DISABLED and self.phase == "idle":
                self._begin("powering")
            case "disable":
                self._lose_power(DISABLED)
            case "home" if self.phase == "idle" and not self.is_homed:
                self._begin("homing")
            case "unhome":
                self.is_homed = self.has_reference = False
                self.phase = "powering" if self.phase == "powering" else "idle"
            case "pause":
                self.state, self.phase = PAUSED, "idle"
            case "resume":
                self.state = ENABLED
        return ""

    def pass_time(self, dt_s: float, has_supply: bool) -> str:
        """A moment passes.

        Args:
            dt_s: how long.
            has_supply: the amplifiers can have power.

        Returns:
            What went wrong in it, in dVRK's words; "" for nothing.
        """
        self._phase_s += dt_s
        if self.has_power and not has_supply:
            return self.fail("detected power loss (actuators / brakes)")
        if self.phase == "powering" and self._phase_s >= POWERING_S and has_supply:
            self.state, self.phase = ENABLED, "idle"
        elif self.phase == "powering" and self._phase_s >= POWER_TIMEOUT_S:
            return self.fail("failed to enable power")
        elif self.phase == "engaging" and self._phase_s >= ENGAGING_S:
            self.is_homed, self.phase = True, "idle"
        return ""

    def arrive(self) -> None:
        """The motion of homing has ended."""
        self.is_homed = self.has_reference = True
        self.phase = "idle"

    def engage(self) -> None:
        """An instrument was put into a homed arm."""
        if self.has_power and self.is_homed:
            self.is_homed = False
            self._begin("engaging")

    def fail(self, why: str) -> str:
        """Goes to FAULT, without power; returns why."""
        self._lose_power(FAULT)
        return why

    def _lose_power(self, state: str) -> None:
        self.state, self.is_homed, self.phase = state, False, "idle"

    def _begin(self, phase: Phase) -> None:
        self.phase, self._phase_s = phase, 0.0
