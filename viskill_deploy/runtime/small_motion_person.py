"""A person as the witness of small motions: told what to expect, asked what there was to see."""

from __future__ import annotations

import math

import numpy as np

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import FloatArray
from viskill_deploy.motion.resolve import task_poses
from viskill_deploy.runtime.moves import axes_of
from viskill_deploy.runtime.operator import Operator, asked
from viskill_deploy.runtime.session import Session
from viskill_deploy.runtime.small_motion import Nudge, name_of

JAW_M = 0.01
"""From the jaw's pivot to the end that people look at, m."""

INSERTION, ROLL, JAW = 2, 3, 6
YES = ("y", "yes")


class PersonsWitness:
    """Somebody who stands at the arms.

    Args:
        operator: asks them.
    """

    def __init__(self, operator: Operator) -> None:
        self._operator = operator

    def look(self) -> None:
        """People see what changes by themselves."""

    def judge(self, session: Session, nudge: Nudge) -> str:
        """What they say; only a plain yes is one."""
        axes = axes_of(session.read())
        expected = described(session.cell, nudge, axes[nudge.arm, :6])
        question = f"{expected} Was it so, and did nothing else move? [y/n]"
        answer = asked(session, self._operator, question)
        if answer is not None and answer.strip().lower() in YES:
            return ""
        return "did something else, says who watched it"


def described(cell: CellDescription, nudge: Nudge, q: FloatArray) -> str:
    """What there is to see of a nudge.

    Args:
        cell: the arms.
        nudge: that was made.
        q: joints of its arm at its end, (6,) rad and m.
    """
    name = name_of(cell, nudge)
    if nudge.axis == JAW:
        return f"{name}: its jaw {_opens(nudge.size)} by {_degrees(nudge.size)}."
    before = q.copy()
    before[nudge.axis] -= nudge.size
    start, end = task_poses(cell, nudge.arm, np.array([before, q]))
    if nudge.axis == ROLL:
        deeper = q.copy()
        deeper[INSERTION] += 0.01
        shaft = (task_poses(cell, nudge.arm, deeper[None])[0] - end)[:3, 3]
        turn = end[:3, :3] @ start[:3, :3].T
        axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        way = "clockwise" if axis @ shaft > 0.0 else "anticlockwise"
        return (
            f"{name}: the instrument turns {way} by {_degrees(nudge.size)}, seen along its shaft "
            "towards the tip."
        )
    point = np.array([0.0, 0.0, JAW_M, 1.0])
    return f"{name}: the end of its jaw moves {_way((end - start) @ point)}."


def _opens(size: float) -> str:
    return "opens" if size > 0.0 else "closes"


def _degrees(size: float) -> str:
    return f"{math.degrees(abs(size)):.0f} degrees"


def _way(moved: FloatArray) -> str:
    """A displacement in the task frame, m, as parts of a millimetre or more."""
    parts = [
        f"{abs(x) * 1e3:.0f} mm to {'+' if x > 0 else '-'}{axis}"
        for x, axis in zip(moved[:3], "xyz", strict=True)
        if abs(x) >= 5e-4
    ]
    return " and ".join(parts) + " of the task frame"
