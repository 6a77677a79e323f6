"""S24: the driver works, and nobody else commands the arms."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from math import ceil, inf
from operator import sub, truediv
from typing import ClassVar

from viskill_deploy.core.types import Action, ArmState, Joints, JointSetpoint, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.track import ArmTrack

TOLERANCE = (0.005, 0.0005)
"""rad, m. A driver that goes through actuators and back loses far less; a person's hand on another
console moves more within a few cycles."""
JAW_TOLERANCE = 0.02
"""rad"""
CLOSE = 0.1
"""Part of the tolerance at which the search through older setpoints ends."""


class Rule:
    """FAULT on a setpoint in the driver that is none of those sent shortly before its sample.

    How old a sample may be is for S18 to say: an old one tells what the driver held then.
    """

    id: ClassVar[str] = "S24"
    needs: ClassVar[Needs] = Needs.STATE

    def __init__(self, cell: CellEnvelope) -> None:
        self._period = cell.period
        self._far = tuple(tuple(TOLERANCE[slides] for slides in arm.slides) for arm in cell.arms)

    def margin(self, cycle: Cycle) -> float:
        """One minus the distance to the nearest setpoint sent, as a part of the tolerance."""
        parts = [0.0]
        for arm, track in zip(cycle.state.arms, cycle.tracks, strict=True):
            sent = track.sent
            if arm.setpoint_jp != sent.jp or arm.jaw_setpoint_jp != sent.jaw:
                parts.append(self._nearest(cycle, arm, track))
        return 1.0 - max(parts)

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict an arm; the value is the distance as a part of the tolerance."""
        for arm, track in zip(cycle.state.arms, cycle.tracks, strict=True):
            part = self._nearest(cycle, arm, track)
            if part > 1.0:
                yield Verdict(self.id, Action.FAULT, track.index, -1, part, 1.0)

    def _nearest(self, cycle: Cycle, arm: ArmState, track: ArmTrack) -> float:
        """Distance to the nearest of the recent setpoints, or to the newest that is close.

        The jaw may lag by another number of cycles than the arm: it has its own topic.
        """
        joints = jaw = inf
        late = track.latency + max(cycle.now - arm.stamp_s, 0.0)
        for sent in islice(reversed(track.recent), 1 + ceil(late / self._period)):
            if joints > CLOSE:
                joints = min(joints, _distance(arm, sent, self._far[track.index]))
            if jaw > CLOSE:
                jaw = min(jaw, abs(arm.jaw_setpoint_jp - sent.jaw) / JAW_TOLERANCE)
        return max(joints, jaw)


def _distance(arm: ArmState, sent: JointSetpoint, far: Joints) -> float:
    distances = map(abs, map(sub, arm.setpoint_jp, sent.jp))
    parts: list[float] = list(map(truediv, distances, far))
    return max(parts)
