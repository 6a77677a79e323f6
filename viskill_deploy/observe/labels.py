"""Plain words for ids: rules, actions, joints."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from viskill_deploy.core.types import PSM_JOINTS, Action

BARE_ID = re.compile(r"(?<![\w(])S\d\d\b(?!\))")

RULES = {
    "S01": "numbers sent are sound",
    "S02": "measurements are sound",
    "S03": "joint limits, commanded",
    "S04": "joint limits, measured",
    "S05": "joint speed",
    "S06": "joint acceleration",
    "S07": "joint jerk",
    "S08": "jump of the setpoint",
    "S09": "first setpoint at the arm",
    "S10": "tip speed",
    "S11": "workspace and floor",
    "S12": "shaft to port",
    "S13": "wrist past the cannula",
    "S14": "distance to collision",
    "S15": "distance to singularity",
    "S16": "solution found in time",
    "S17": "tracking error",
    "S18": "age of the feedback",
    "S19": "next waypoint on time",
    "S20": "loop on time",
    "S21": "clock",
    "S22": "operator's consent",
    "S23": "emergency stop and arm state",
    "S24": "driver and second commander",
    "S25": "heartbeat",
    "S26": "watchdog",
    "S27": "calibration",
    "S28": "bundle",
    "S29": "observation in training range",
    "S30": "jaw",
    "S31": "latched faults",
    "S32": "record being kept",
}

ACTIONS = {
    Action.PASS: "passed",
    Action.WARN: "warned",
    Action.SCALE: "slowed",
    Action.HOLD: "held",
    Action.STOP: "stopped",
    Action.FAULT: "fault",
    Action.ESTOP: "emergency stop",
}


def rule_label(rule: str) -> str:
    """Words for a rule, such as "joint speed (S05)"; the id itself when it is not known."""
    return f"{RULES[rule]} ({rule})" if rule in RULES else rule


def with_labels(text: str) -> str:
    """A text in which every bare id of a rule is replaced by its words."""
    return BARE_ID.sub(lambda found: rule_label(found[0]), text)


def action_label(action: int) -> str:
    """Words for what the gate did."""
    return ACTIONS.get(Action(action), str(action)) if action in set(Action) else str(action)


def joint_label(joint: int, joints: Sequence[str] = PSM_JOINTS) -> str:
    """Name of a joint by its index; behind the last one is the jaw, -1 the whole arm."""
    names = (*joints, "jaw")
    return names[joint].replace("_", " ") if 0 <= joint < len(names) else "whole arm"


def shown_joint(slides: bool, value: float) -> tuple[float, str]:
    """A joint value in the unit that people read: degrees, or mm where the joint slides."""
    return (value * 1e3, "mm") if slides else (math.degrees(value), "°")
