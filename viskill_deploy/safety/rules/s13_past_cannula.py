"""S13: the instrument moves in Cartesian space only with its wrist past the cannula."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.track import ArmTrack

INSERTION = 2


class Rule:
    """HOLD; from inside the cannula only a plain insertion passes (and standing still)."""

    id: ClassVar[str] = "S13"
    needs: ClassVar[Needs] = Needs.REQUEST

    def __init__(self, cell: CellEnvelope) -> None:
        self._least = tuple(arm.insertion_min for arm in cell.arms)
        self._scale = tuple(1.0 / (arm.upper[2] - arm.insertion_min) for arm in cell.arms)

    def margin(self, cycle: Cycle) -> float:
        """Insertion past the cannula, as a part of the range beyond it."""
        parts = [1.0]
        for track, least, scale in zip(cycle.tracks, self._least, self._scale, strict=True):
            past = track.asked_q[INSERTION] - least
            if past < 0.0 and _is_more_than_insertion(track):
                return -1.0
            parts.append(past * scale)
        return max(min(parts), 0.0)

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """One verdict an arm that moves with its wrist in the cannula."""
        for track, least in zip(cycle.tracks, self._least, strict=True):
            insertion = track.asked_q[INSERTION]
            if insertion < least and _is_more_than_insertion(track):
                yield Verdict(self.id, Action.HOLD, track.index, INSERTION, insertion, least)


def _is_more_than_insertion(track: ArmTrack) -> bool:
    """Any joint but the insertion moves, or the insertion goes back. The jaw is free."""
    moves = [new != old for new, old in zip(track.asked_q[:6], track.q[:6], strict=True)]
    moves[INSERTION] = track.asked_q[INSERTION] < track.q[INSERTION]
    return any(moves)
