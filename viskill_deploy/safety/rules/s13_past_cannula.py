"""S13: the instrument moves in Cartesian space only with its wrist past the cannula."""

from __future__ import annotations

from collections.abc import Iterator
from math import dist
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.geometry import Point
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.track import ArmTrack

INSERTION = 2
FULL_DEPTH_M = 0.2
"""Depth past the cannula at which the margin of an arm without an insertion is 1.0."""
STRAIGHT = 1.01
"""A motion is a plain insertion if its way is no longer than this many times what the tip goes
deeper by: it leads within 8 degrees of the shaft's axis."""


class Rule:
    """HOLD; from inside the cannula only a plain insertion passes (and standing still).

    An arm without a mechanical remote centre has no joint that inserts. For it the depth of the
    control point past the port counts, and a plain insertion is a motion along the shaft.
    """

    id: ClassVar[str] = "S13"
    needs: ClassVar[Needs] = Needs.REQUEST

    def __init__(self, cell: CellEnvelope) -> None:
        self._least = tuple(arm.insertion_min for arm in cell.arms)
        self._scale = tuple(
            1.0 / (arm.upper[2] - arm.insertion_min if arm.has_remote_centre else FULL_DEPTH_M)
            for arm in cell.arms
        )

    def margin(self, cycle: Cycle) -> float:
        """Insertion past the cannula, as a part of the range beyond it."""
        parts: list[float] = []
        for track, least, scale in zip(cycle.tracks, self._least, self._scale, strict=True):
            past = _depth(track) - least
            if past < 0.0 and _is_more_than_insertion(track):
                return -1.0
            parts.append(past * scale)
        return max(min(parts), 0.0)

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict an arm that moves with its wrist in the cannula."""
        for track, least in zip(cycle.tracks, self._least, strict=True):
            depth = _depth(track)
            if depth < least and _is_more_than_insertion(track):
                joint = INSERTION if track.envelope.has_remote_centre else -1
                yield Verdict(self.id, Action.HOLD, track.index, joint, depth, least)


def _depth(track: ArmTrack) -> float:
    """What is asked of the insertion, m; of an arm without one, how deep the tip is asked to be."""
    arm = track.envelope
    if arm.has_remote_centre:
        return track.asked_q[INSERTION]
    return _past(arm.port, *track.asked_points[:2])


def _past(port: Point, point: Point, jaw_end: Point) -> float:
    """How far the control point is past a port, along the instrument, m."""
    length = dist(point, jaw_end)
    parts = zip(port, point, jaw_end, strict=True)
    return sum([(p - o) * (j - p) for o, p, j in parts]) / length


def _is_more_than_insertion(track: ArmTrack) -> bool:
    """Any joint but the insertion moves, or the insertion goes back. The jaw is free."""
    arm = track.envelope
    if not arm.has_remote_centre:
        deeper = _depth(track) - _past(arm.port, *track.points[:2])
        way = dist(track.asked_point, track.point)
        return not way <= deeper * STRAIGHT
    moves = [new != old for new, old in zip(track.asked_q[:-1], track.q[:-1], strict=True)]
    moves[INSERTION] = track.asked_q[INSERTION] < track.q[INSERTION]
    return any(moves)
