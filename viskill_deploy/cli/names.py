"""Names of frames and control points as options of commands."""

from __future__ import annotations

import enum
from typing import Literal


class FrameName(enum.Enum):
    """Where a pose is seen from; see `motion.frames`."""

    TASK = "task"
    CRTK = "crtk"
    RCM = "rcm"
    WORLD = "world"
    SURROL = "surrol"

    value: Literal["task", "crtk", "rcm", "world", "surrol"]


class PointName(enum.Enum):
    """Point of the tool that a position is about."""

    JAW_PIVOT = "jaw-pivot"
    JAW_END = "jaw-end"

    value: Literal["jaw-pivot", "jaw-end"]
