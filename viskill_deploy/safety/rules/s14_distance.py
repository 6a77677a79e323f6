"""S14: parts of the arms stay apart from each other and from what stands in the cell."""

from __future__ import annotations

from collections.abc import Iterator
from math import dist, inf
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.clearances import Apart
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import ROUNDING, CellEnvelope
from viskill_deploy.safety.geometry import Points
from viskill_deploy.safety.reach import Reach
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.track import LEAP, ArmTrack

FAR_M = 0.05
"""A margin of 1.0: nothing nearer than this."""


class Rule:
    """SCALE, then STOP, by the distance that is left when the gate's own stop has ended.

    That is the distance less what the closing speed still takes of it. Moving apart, or standing,
    passes; standing with the core lines of two parts in each other does not, since nobody knows
    the way out.

    Far pairs cost nothing: a distance shrinks by no more than the arms travel. A pair is looked at
    again when what they have travelled since, and may still travel in a stop, could use up half of
    what was free.
    """

    id: ClassVar[str] = "S14"
    needs: ClassVar[Needs] = Needs.REQUEST

    def __init__(self, cell: CellEnvelope) -> None:
        self._apart = cell.apart
        self._ports = tuple(arm.port for arm in cell.arms)
        self._has_jaw = any(2 in apart.parts for apart in cell.apart)
        self._reaches = [Reach(arm, cell.period, self._has_jaw) for arm in cell.arms]
        self._free = [inf] * len(self._apart)
        self._due = [-inf] * len(self._apart)
        self._next, self._used = -inf, 0.0
        self._margin: float
        self._verdicts: list[Verdict] = []

    def margin(self, cycle: Cycle) -> float:
        """Smallest distance over its slow one at the last look, in parts of 5 cm.

        The true one is at least half of it.
        """
        tracks = cycle.tracks
        if max([track.fastest for track in tracks]) > LEAP:
            return 1.0
        if cycle.is_first:
            self._due, self._next = [-inf] * len(self._apart), -inf
        self._used += 2.0 * sum([self._travelled(track) for track in tracks])
        to_rest = sum([reach.travel(t) for reach, t in zip(self._reaches, tracks, strict=True)])
        if self._used + to_rest > self._next:
            self._look(tracks, to_rest)
        return self._margin

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict a pair; values are ways by which it comes nearer until rest, m.

        The value is what it would be, the limit what the slow or the stop distance leaves.
        """
        yield from self._verdicts

    def _travelled(self, track: ArmTrack) -> float:
        """Way of the fastest of an arm's points in this cycle, m."""
        point, jaw_end, wrist, shaft_end = track.asked_points
        _, jaw_end_before, wrist_before, shaft_end_before = track.points
        way = max(dist(point, track.point), dist(wrist, wrist_before))
        way = max(way, dist(shaft_end, shaft_end_before))
        return max(way, dist(jaw_end, jaw_end_before)) if self._has_jaw else way

    def _look(self, tracks: tuple[ArmTrack, ...], to_rest: float) -> None:
        """Measures the pairs that are due, and judges those that a stop could bring near."""
        asked = [track.asked_points for track in tracks]
        ways: list[list[Points]] = []
        self._verdicts.clear()
        for index, apart in enumerate(self._apart):
            if self._used + to_rest <= self._due[index]:
                continue
            gap = apart.gap(self._ports, asked)
            free = self._free[index] = gap - apart.slow
            self._due[index] = self._used + free
            if free <= to_rest:
                ways = ways or _ways(tracks)
                left = min(gap, *[apart.gap(self._ports, points) for points in ways])
                self._judge(apart, tracks, left)
        self._next = min(self._due, default=inf)
        free = min(self._free, default=inf)
        self._margin = -1.0 if self._verdicts else min(max(free / FAR_M, 0.0), 1.0)

    def _judge(self, apart: Apart, tracks: tuple[ArmTrack, ...], left: float) -> None:
        before = apart.gap(self._ports, [track.points for track in tracks])
        arm = apart.arms[0] if apart.arms[1] < 0 else -1
        is_inside = left <= ROUNDING - apart.radius
        if is_inside or left < min(before, apart.stop * (1.0 - ROUNDING)):
            action, limit = Action.STOP, before - apart.stop
        elif left < min(before, apart.slow * (1.0 - ROUNDING)):
            action, limit = Action.SCALE, max(before - apart.slow, 0.0)
        else:
            return
        self._verdicts.append(Verdict(self.id, action, arm, -1, before - left, limit))


def _ways(tracks: tuple[ArmTrack, ...]) -> list[list[Points]]:
    """All points half way through the gate's stop from what is asked, and at its end."""
    halves, ends = [], []
    for track in tracks:
        arm = track.envelope
        end = track.asked_end()
        half = tuple(0.5 * (p + q) for p, q in zip(end, track.asked_q, strict=False))
        halves.append(arm.chain.points(half))
        ends.append(arm.chain.points(end))
    return [halves, ends]
