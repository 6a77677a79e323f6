"""S15: the arm keeps away from singularities, and its joints bring the tip where it is meant."""

from __future__ import annotations

from collections.abc import Iterator
from math import dist, inf, isfinite, sqrt
from operator import mul, sub
from typing import ClassVar

import numpy as np

from viskill_deploy.core.types import Action, Joints, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import ROUNDING, ArmEnvelope, CellEnvelope
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.track import ArmTrack

CHANGE: Joints = (0.0, 0.3, 1.0, 0.3, 0.3, 0.0)
"""The most that the smallest singular value changes with each joint, m a rad and m a m. The first
joint turns the Jacobian as a whole, the last one turns about the control point. For the others a
test looks at random configurations of every instrument: 0.21 and 0.71 are the largest there."""

STILL_M = 1e-9
"""A change of the singular value that is rounding."""


class Rule:
    """SCALE, then HOLD, on the way to a singularity; away from it, or at rest, passes.

    The smallest singular value is worked out anew once the joints have moved so far that half of
    what is free of it may be gone. A tip that its setpoint does not bring to its path is a HOLD.
    """

    id: ClassVar[str] = "S15"
    needs: ClassVar[Needs] = Needs.REQUEST

    def __init__(self, cell: CellEnvelope) -> None:
        self._changes = [CHANGE if arm.has_remote_centre else changes(arm) for arm in cell.arms]
        self._at: list[Joints] = [()] * len(cell.arms)
        self._seen = [-inf] * len(cell.arms)

    def margin(self, cycle: Cycle) -> float:
        """The smallest singular value's room over the one that slows, as a part of that.

        A lower bound of it, at least a third; or one minus the residual as a part of its limit.
        """
        parts: list[float] = []
        for track in cycle.tracks:
            slow, value = track.envelope.slow_value, self._at_least(track)
            is_bad = _is_under(value, slow) and self._is_approaching(track)
            room = -1.0 if is_bad else max(value / slow - 1.0, 0.0)
            parts += (room, 1.0 - _residual(cycle, track))
        return min(parts)

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """Rad of a joint that a metre of the tip asks for, of an arm too near; a residual, m."""
        for track in cycle.tracks:
            arm, value = track.envelope, smallest_singular_value(track.envelope, track.asked_q)
            if _is_under(value, arm.slow_value) and self._is_approaching(track):
                is_near = _is_under(value, arm.least_value)
                action = Action.HOLD if is_near else Action.SCALE
                limit = arm.least_value if is_near else arm.slow_value
                turn = 1.0 / value if value > 0.0 else inf
                yield Verdict(self.id, action, track.index, -1, turn, 1.0 / limit)
            part, allowed = _residual(cycle, track), arm.ik_residual
            if part > 1.0:
                yield Verdict(self.id, Action.HOLD, track.index, -1, part * allowed, allowed)

    def _at_least(self, track: ArmTrack) -> float:
        """A bound under the smallest singular value; itself where it is near or below `slow`."""
        index, q = track.index, track.asked_q
        change: float = sum(map(mul, map(abs, map(sub, q, self._at[index])), self._changes[index]))
        if not 2.0 * change <= self._seen[index] - track.envelope.slow_value:
            self._at[index], change = q, 0.0
            self._seen[index] = smallest_singular_value(track.envelope, q)
        return self._seen[index] - change

    def _is_approaching(self, track: ArmTrack) -> bool:
        asked = smallest_singular_value(track.envelope, track.asked_q)
        return asked < smallest_singular_value(track.envelope, track.q) - STILL_M


def _is_under(value: float, bound: float) -> bool:
    return value < bound * (1.0 - ROUNDING)


def changes(arm: ArmEnvelope) -> Joints:
    """The most that the smallest singular value changes with each joint of any serial arm.

    It changes by no more than the norm of the Jacobian's derivative. A joint turns the columns of
    all joints behind it, each of length sqrt(lever^2 + 1) at most, and moves the tip for those
    before it and for itself by its own lever. The first joint turns the Jacobian as a whole.
    """
    columns = [lever * lever + 1.0 for lever in arm.levers]
    bounds = [
        sqrt((joint + 1) * lever * lever + sum(columns[joint + 1 :]))
        for joint, lever in enumerate(arm.levers)
    ]
    return (0.0, *bounds[1:])


def smallest_singular_value(arm: ArmEnvelope, q: Joints) -> float:
    """Of the Jacobian of an arm's control point, m; 0 where that is no matrix of numbers."""
    columns = arm.chain.jacobian(q)
    if not isfinite(sum(map(sum, columns))):
        return 0.0
    values: list[float] = np.linalg.svd(columns, compute_uv=False).tolist()
    return values[-1]


def _residual(cycle: Cycle, track: ArmTrack) -> float:
    """From where the tip is meant to be to where the setpoint brings it, in parts of the limit."""
    tips = cycle.request.tips
    if not tips:
        return 0.0
    far = dist(track.asked_point, tips[track.index])
    return far * (1.0 - ROUNDING) / track.envelope.ik_residual
