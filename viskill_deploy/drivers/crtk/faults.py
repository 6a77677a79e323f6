"""What can be made to go wrong with a simulated dVRK, by name, from tests and over its socket."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.crtk.arm_on_wire import ArmOnWire

Fault = Literal[
    "tracking",
    "potentiometers",
    "current",
    "amplifiers",
    "watchdog",
    "power",
    "silence",
    "invalid",
    "short",
    "nan",
    "following",
    "second commander",
    "clutch",
    "tool",
    "paused",
    "disabled",
]
"""tracking: tracking error, FAULT. potentiometers, current, amplifiers, watchdog: the boards find
encoders that contradict potentiometers, too much current, an amplifier that fails, or no
controller, and take the power: FAULT. power: the amplifiers have no power and get none meanwhile.
silence: nothing periodic is published. invalid: what is published is marked as invalid. short:
measured_js has five entries. nan: a measured joint is no number. following: a teleoperation says
that it commands this arm. second commander: somebody else sends it servo_jp. clutch: the button on
the arm is pressed. tool: the instrument is taken out. paused, disabled: another program says so to
the arm, which is not ready for setpoints then."""

Act = Callable[[ArmOnWire, bool], None]
"""Begins or ends a fault."""


def cause(arm: ArmOnWire, fault: str, is_on: bool) -> None:
    """Begins or ends a fault of one arm.

    Raises:
        DriverError: there is no such fault.
    """
    if fault not in _ACTS:
        raise DriverError(f"no fault {fault!r}; there are {', '.join(_ACTS)}")
    _ACTS[fault](arm, is_on)


def _failing(why: str) -> Act:
    def act(arm: ArmOnWire, is_on: bool) -> None:
        if is_on:
            arm.arm.fail(why)

    return act


def _supply(arm: ArmOnWire, is_on: bool) -> None:
    arm.has_supply = not is_on


def _silence(arm: ArmOnWire, is_on: bool) -> None:
    arm.is_silent = is_on


def _invalid(arm: ArmOnWire, is_on: bool) -> None:
    arm.is_invalid = is_on


def _spoiled(how: Callable[[str, Any], Any]) -> Act:
    def act(arm: ArmOnWire, is_on: bool) -> None:
        arm.spoil = how if is_on else _sound

    return act


def _intrude(arm: ArmOnWire, is_on: bool) -> None:
    arm.intruder = arm.arm.motion.setpoint.jp if is_on else ()


def _told(word: str) -> Act:
    def act(arm: ArmOnWire, is_on: bool) -> None:
        if is_on:
            arm.arm.state_command(word)

    return act


def _sound(topic: str, message: Any) -> Any:
    del topic
    return message


def _short(topic: str, message: Any) -> Any:
    if topic != "measured_js":
        return message
    return replace(
        message,
        name=message.name[:5],
        position=message.position[:5],
        velocity=message.velocity[:5],
        effort=message.effort[:5],
    )


def _nan(topic: str, message: Any) -> Any:
    if topic != "measured_js":
        return message
    return replace(message, position=(math.nan, *message.position[1:]))


_ACTS: dict[str, Act] = {
    "tracking": _failing("tracking error, mask [1, 0, 0, 0, 0, 0, 0]"),
    "potentiometers": _failing("inconsistency between encoders and potentiometers"),
    "current": _failing("too many consecutive current safety violations"),
    "amplifiers": _failing("hardware error, an amplifier is disabled or too hot"),
    "watchdog": _failing("watchdog triggered"),
    "power": _supply,
    "silence": _silence,
    "invalid": _invalid,
    "short": _spoiled(_short),
    "nan": _spoiled(_nan),
    "following": lambda arm, is_on: arm.follow(is_on),
    "second commander": _intrude,
    "clutch": lambda arm, is_on: arm.press_clutch(is_on),
    "tool": lambda arm, is_on: arm.arm.emulate_tool(not is_on),
    "paused": _told("pause"),
    "disabled": _told("disable"),
}
