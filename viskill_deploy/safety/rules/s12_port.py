"""S12: the axis of each shaft passes through its registered port."""

from __future__ import annotations

from collections.abc import Iterator
from math import sqrt
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import ROUNDING, CellEnvelope
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.track import LEAP, ArmTrack


class Rule:
    """WARN, then STOP. By the gate's own kinematics, at the setpoint.

    A mechanical remote centre keeps the nominal shaft in its own port whatever the joints do. What
    this rule finds is a port that was registered elsewhere, or calibrated rows that no longer meet.
    On an arm without one it is the constraint itself: nothing but the line keeps the shaft there,
    and the gate's own stop is one that stays there too (`stopping.CommonStop`).
    """

    id: ClassVar[str] = "S12"
    needs: ClassVar[Needs] = Needs.REQUEST

    def __init__(self, cell: CellEnvelope) -> None:
        self._warn = tuple(arm.port_warn * (1.0 + ROUNDING) for arm in cell.arms)
        self._stop = tuple(arm.port_stop * (1.0 + ROUNDING) for arm in cell.arms)

    def margin(self, cycle: Cycle) -> float:
        """One minus the largest distance as a part of the warning's."""
        return 1.0 - max([_distance(t) / self._warn[t.index] for t in cycle.tracks])

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict an arm whose shaft has left its port; the value is the distance, m."""
        for track in cycle.tracks:
            distance, arm = _distance(track), track.envelope
            if distance > self._stop[track.index]:
                yield Verdict(self.id, Action.STOP, track.index, -1, distance, arm.port_stop)
            elif distance > self._warn[track.index]:
                yield Verdict(self.id, Action.WARN, track.index, -1, distance, arm.port_warn)


def _distance(track: ArmTrack) -> float:
    """From the port to the line through the wrist and the shaft's end, m; 0.0 in a leap."""
    if track.fastest > LEAP:
        return 0.0
    _, _, (a, b, c), (d, e, f) = track.asked_points
    x, y, z = track.envelope.port
    u, v, w = d - a, e - b, f - c
    x, y, z = x - a, y - b, z - c
    p, q, r = v * z - w * y, w * x - u * z, u * y - v * x
    return sqrt((p * p + q * q + r * r) / (u * u + v * v + w * w))
