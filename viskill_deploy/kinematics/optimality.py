"""What a QP solver's answer has to show before it is believed.

At a minimum in a box the gradient vanishes along every free joint, and at a bound it may only push
outwards (Nocedal and Wright, Numerical Optimization, section 12.3). That is checked on the answer
itself, so that no solver's status needs to be trusted.
"""

from __future__ import annotations

import math

import numpy as np

from viskill_deploy.core.errors import IkError
from viskill_deploy.core.types import FloatArray

PROJECTION = 1e-6
"""A first-order solver's answer this little outside the box is put onto it, then checked anew."""

RESIDUAL_TOLERANCE = 1e-6
"""Largest violation of the optimality conditions, relative to the gradient at rest."""


def is_free_minimum(
    v: list[float], gradient: list[float], lower: list[float], upper: list[float]
) -> bool:
    """Whether the answer lies inside the box and no bound is needed to keep it there.

    The common case of a tick, told in one pass; NaN is never one.
    """
    for x, g, low, high in zip(v, gradient, lower, upper, strict=True):
        if not (low <= x <= high and -RESIDUAL_TOLERANCE <= g <= RESIDUAL_TOLERANCE):
            return False
    return True


def onto_box(v: list[float], lower: list[float], upper: list[float]) -> list[float]:
    """`v` with what is outside by a solver's tolerance put exactly onto the box.

    Raises:
        IkError: "not-finite", or "outside-box" when it is further out than `PROJECTION`.
    """
    if not math.isfinite(sum(v)):
        raise IkError("not-finite", f"the solver returned {v}; hold and check the model")
    inside = []
    for i, (x, low, high) in enumerate(zip(v, lower, upper, strict=True)):
        bounded = low if x < low else high if x > high else x
        if abs(bounded - x) > PROJECTION:
            raise IkError(
                "outside-box",
                f"the solver left the box of joint {i} by {abs(bounded - x):.3g} per s; choose a "
                "more exact solver",
            )
        inside.append(bounded)
    return inside


def optimality(
    v: list[float], gradient: list[float], lower: list[float], upper: list[float]
) -> tuple[float, tuple[int, ...]]:
    """Largest violation of the optimality conditions in a box, and which bounds hold back.

    A positive gradient is right at a lower bound only, a negative one at an upper bound only.

    Returns:
        The violation, and per joint 1 where its upper bound holds it back, -1 where its lower one
        does, 0 where neither does.
    """
    worst, active = 0.0, []
    for x, g, low, high in zip(v, gradient, lower, upper, strict=True):
        at_low, at_high = x - low <= PROJECTION, high - x <= PROJECTION
        if (g > worst and not at_low) or (-g > worst and not at_high):
            worst = abs(g)
        holds = abs(g) > RESIDUAL_TOLERANCE
        active.append((holds and g < 0.0 and at_high) - (holds and g > 0.0 and at_low))
    return worst, tuple(active)


def check_rows(
    rows: tuple[FloatArray, FloatArray, FloatArray], multipliers: FloatArray, v: FloatArray
) -> None:
    """Refuses an answer that leaves the general rows, or whose multipliers push at slack ones.

    Raises:
        IkError: "infeasible" or "residual".
    """
    A, low, high = rows
    value = A.dot(v)
    over = float(np.maximum(low - value, value - high).max())
    if not over <= PROJECTION:
        raise IkError(
            "infeasible", f"the shaft leaves the port's band by {over:.3g} m/s; hold, then retract"
        )
    slack = np.where(multipliers > 0, high - value, value - low)
    push = float((slack * np.abs(multipliers)).max())
    if not push <= RESIDUAL_TOLERANCE * (1.0 + float(np.abs(multipliers).max())):
        raise IkError("residual", "the solver's multipliers do not fit its answer; try another")
