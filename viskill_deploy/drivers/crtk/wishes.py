"""The states that a client may wish an arm into, and what it says for that in each state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from viskill_deploy.drivers.base import DISABLED, ENABLED, PAUSED
from viskill_deploy.drivers.crtk.arm import FAULT, ArmClient


@dataclass(frozen=True, slots=True)
class Wish:
    """What an arm is to become.

    Attributes:
        name: for messages.
        word: the state command that leads there from where an arm is; "" to wait.
        patience_s: how long an arm gets.
        is_met: whether it has become so.
        is_stop: said also to an arm that is busy or in FAULT.
    """

    name: str
    word: Callable[[ArmClient], str]
    patience_s: float
    is_met: Callable[[ArmClient], bool]
    is_stop: bool = False

    def press(self, arm: ArmClient, now: float) -> bool:
        """Says what leads there, if need be; returns whether the arm is as wished.

        It is said again every half second without effect: what comes before the arm's program has
        found ours is lost. An arm that is busy has heard.
        """
        if self.is_met(arm):
            return True
        word = self.word(arm)
        if word and (self.is_stop or not arm.condition.is_busy):
            arm.command(word, now)
        return False


def _to_enabled(arm: ArmClient) -> str:
    return {DISABLED: "enable", PAUSED: "resume"}.get(arm.condition.state, "")


def _to_homed(arm: ArmClient) -> str:
    return "home" if arm.condition.state == ENABLED and not arm.condition.is_homed else ""


ENABLE: Final = Wish(
    "enable",
    _to_enabled,
    15.0,  # dVRK gives up after 6 s without power; encoders take a moment more
    lambda arm: arm.condition.state == ENABLED and not arm.condition.is_busy,
)
HOME: Final = Wish(
    "home",
    _to_homed,
    60.0,  # up to 30 s for the encoders' bias, then the way to where homing ends
    lambda arm: arm.is_ready and arm.is_known,
)
PAUSE: Final = Wish(
    "pause",
    lambda arm: "pause",
    0.5,
    lambda arm: arm.condition.state != ENABLED,
    is_stop=True,
)
DISABLE: Final = Wish(
    "disable",
    lambda arm: "disable",
    2.0,
    lambda arm: arm.condition.state in {DISABLED, FAULT} and not arm.condition.is_busy,
    is_stop=True,
)
"""An arm in FAULT has no power, and stays in FAULT until a person has looked at it."""

RECOVER: Final = Wish(
    "disable",
    lambda arm: "disable",
    2.0,
    lambda arm: arm.condition.state == DISABLED and not arm.condition.is_busy,
    is_stop=True,
)
