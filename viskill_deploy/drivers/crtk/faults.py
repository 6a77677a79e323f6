"""What can be made to go wrong with a simulated dVRK, by name, from tests and over its socket."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal, get_args

from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.crtk.arm_on_wire import ArmOnWire

Fault = Literal[
    "tracking",
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
"""tracking: tracking error, FAULT. power: the amplifiers have no power and get none meanwhile.
silence: nothing periodic is published. invalid: what is published is marked as invalid. short:
measured_js has five entries. nan: a measured joint is no number. following: a teleoperation says
that it commands this arm. second commander: somebody else sends it servo_jp. clutch: the button on
the arm is pressed. tool: the instrument is taken out. paused, disabled: another program says so to
the arm, which is not ready for setpoints then."""


def cause(arm: ArmOnWire, fault: str, is_on: bool) -> None:
    """Begins or ends a fault of one arm.

    Raises:
        DriverError: there is no such fault.
    """
    match fault:
        case "tracking":
            if is_on:
                arm.arm.fail("tracking error, mask [1, 0, 0, 0, 0, 0, 0]")
        case "power":
            arm.has_supply = not is_on
        case "silence":
            arm.is_silent = is_on
        case "invalid":
            arm.is_invalid = is_on
        case "short":
            arm.spoil = _short if is_on else _sound
        case "nan":
            arm.spoil = _nan if is_on else _sound
        case "following":
            arm.follow(is_on)
        case "second commander":
            arm.intruder = arm.arm.motion.setpoint.jp if is_on else ()
        case "clutch":
            arm.press_clutch(is_on)
        case "tool":
            arm.arm.emulate_tool(not is_on)
        case "paused" | "disabled":
            if is_on:
                arm.arm.state_command("pause" if fault == "paused" else "disable")
        case _:
            raise DriverError(f"no fault {fault!r}; there are {', '.join(get_args(Fault))}")


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
