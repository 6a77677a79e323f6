"""How far over a limit the time base may be asked to slow down instead of stopping."""

from __future__ import annotations

from collections.abc import Iterator

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.envelope import ROUNDING

SCALE_UP_TO = 1.2
"""A tenth over what plans use is jitter of the plan; a fifth over the limit is a wrong plan."""


def scale_or_hold(rule: str, arm: int, joint: int, value: float, limit: float) -> Iterator[Verdict]:
    """Nothing inside the limit, SCALE a little above it, HOLD beyond."""
    if value * (1.0 - ROUNDING) > limit:
        small = value * (1.0 - ROUNDING) <= SCALE_UP_TO * limit
        yield Verdict(rule, Action.SCALE if small else Action.HOLD, arm, joint, value, limit)
