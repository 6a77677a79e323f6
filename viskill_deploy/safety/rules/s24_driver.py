"""S24: the driver works, and nobody else commands the arms."""

from __future__ import annotations

from collections.abc import Iterator
from math import inf
from operator import sub, truediv
from typing import ClassVar

from viskill_deploy.core.types import Action, ArmState, JointSetpoint, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.track import ArmTrack

TOLERANCE = (0.005, 0.005, 0.0005, 0.005, 0.005, 0.005)
"""rad, m. A driver that goes through actuators and back loses far less; a person's hand on another
console moves more within a few cycles."""
JAW_TOLERANCE = 0.02
"""rad"""
CLOSE = 0.1
"""Part of the tolerance at which the search through older setpoints ends."""


class Rule:
    """FAULT on a setpoint in the driver that is none of those sent lately."""

    id: ClassVar[str] = "S24"
    needs: ClassVar[Needs] = Needs.STATE

    def __init__(self, cell: CellEnvelope) -> None:
        del cell  # the tolerance is one for all cells

    def margin(self, cycle: Cycle) -> float:
        """One minus the distance to the nearest setpoint sent, as a part of the tolerance."""
        parts = [0.0]
        for arm, track in zip(cycle.state.arms, cycle.tracks, strict=True):
            sent = track.sent
            if arm.setpoint_jp != sent.jp or arm.jaw_setpoint_jp != sent.jaw:
                parts.append(_nearest(arm, track))
        return 1.0 - max(parts)

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict an arm; the value is the distance as a part of the tolerance."""
        for arm, track in zip(cycle.state.arms, cycle.tracks, strict=True):
            part = _nearest(arm, track)
            if part > 1.0:
                yield Verdict(self.id, Action.FAULT, track.index, -1, part, 1.0)


def _nearest(arm: ArmState, track: ArmTrack) -> float:
    """Distance to the nearest of the recent setpoints, or to the newest that is close.

    The jaw may lag by another number of cycles than the arm: it has its own topic.
    """
    joints = jaw = inf
    for sent in reversed(track.recent):
        if joints > CLOSE:
            joints = min(joints, _distance(arm, sent))
        if jaw > CLOSE:
            jaw = min(jaw, abs(arm.jaw_setpoint_jp - sent.jaw) / JAW_TOLERANCE)
    return max(joints, jaw)


def _distance(arm: ArmState, sent: JointSetpoint) -> float:
    distances = map(abs, map(sub, arm.setpoint_jp, sent.jp))
    parts: list[float] = list(map(truediv, distances, TOLERANCE))
    return max(parts)
