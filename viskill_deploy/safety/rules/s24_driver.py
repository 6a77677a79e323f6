"""S24: the driver works, and nobody else commands the arms."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from viskill_deploy.core.types import Action, ArmState, JointSetpoint, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.track import ArmTrack

TOLERANCE = (0.005, 0.005, 0.0005, 0.005, 0.005, 0.005, 0.02)
"""rad, m. A driver that goes through actuators and back loses far less; a person's hand on another
console moves more within a few cycles. The last entry is the jaw's."""


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
    """Distance to the nearest of the recent setpoints; 0 when one is met.

    The jaw may lag by another number of cycles than the arm: it has its own topic.
    """
    joints = min(_distance(arm, sent) for sent in track.recent)
    jaw = min(abs(arm.jaw_setpoint_jp - sent.jaw) for sent in track.recent)
    return max(joints, jaw / TOLERANCE[6])


def _distance(arm: ArmState, sent: JointSetpoint) -> float:
    return max(
        abs(held - ours) / tolerance
        for held, ours, tolerance in zip(arm.setpoint_jp, sent.jp, TOLERANCE[:6], strict=True)
    )
