"""S11: the control point stays in its workspace and the jaw's end above the floor."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.geometry import Point
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.track import ArmTrack

REACH_M = 1e-9
"""A nanometre outside is rounding."""


class Rule:
    """HOLD on the way out; coming back in, or staying, passes. All in the task frame."""

    id: ClassVar[str] = "S11"
    needs: ClassVar[Needs] = Needs.REQUEST

    def __init__(self, cell: CellEnvelope) -> None:
        self._floor = cell.floor
        self._boxes = tuple((arm.workspace_lower, arm.workspace_upper) for arm in cell.arms)
        self._scale = tuple(
            2.0 / min(high - low for low, high in zip(*box, strict=True)) for box in self._boxes
        )

    def margin(self, cycle: Cycle) -> float:
        """Distance to the nearest wall or the floor, as a part of half the narrowest side."""
        gaps: list[float] = []
        for track, scale in zip(cycle.tracks, self._scale, strict=True):
            gap = self._gap(track.index, track.asked_point, track.asked_jaw_end)
            if self._is_leaving(track, gap):
                return -1.0
            gaps.append(gap * scale)
        return max(min(gaps), 0.0)

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict an arm on its way out; the value is its distance beyond the wall, m."""
        for track in cycle.tracks:
            gap = self._gap(track.index, track.asked_point, track.asked_jaw_end)
            if self._is_leaving(track, gap):
                yield Verdict(self.id, Action.HOLD, track.index, -1, -gap, 0.0)

    def _is_leaving(self, track: ArmTrack, gap: float) -> bool:
        if gap < 0.0 and track.asked_q != track.q:
            return gap <= self._gap(track.index, track.point, track.jaw_end)
        return False

    def _gap(self, arm: int, point: Point, jaw_end: Point) -> float:
        """Distance to the nearest wall or the floor, m; negative outside."""
        x, y, z = point
        (left, near, low), (right, far, high) = self._boxes[arm]
        return REACH_M + min(
            x - left, right - x, y - near, far - y, z - low, high - z, jaw_end[2] - self._floor
        )
