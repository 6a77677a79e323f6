"""How far over a limit the time base may be asked to slow down instead of stopping."""

from __future__ import annotations

from collections.abc import Iterator

from viskill_deploy.core.types import Action, Verdict

SCALE_UP_TO = 1.2
"""A tenth over what plans use is jitter of the plan; a fifth over the limit is a wrong plan."""


def scale_or_hold(rule: str, arm: int, joint: int, part: float, limit: float) -> Iterator[Verdict]:
    """Nothing inside the limit, SCALE a little above it, HOLD beyond.

    Args:
        rule: id of the rule that asks.
        arm: index of the arm, -1 for the cell.
        joint: index of the joint, -1 for the whole arm.
        part: the value as a part of its limit, with a rounding's width taken off.
        limit: the limit.
    """
    if part > 1.0:
        action = Action.SCALE if part <= SCALE_UP_TO else Action.HOLD
        yield Verdict(rule, action, arm, joint, part * limit, limit)
