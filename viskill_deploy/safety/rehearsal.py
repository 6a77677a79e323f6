"""A gate to try a plan on: it judges like the real one and lets nothing out."""

from __future__ import annotations

from math import isnan

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import CellState, ObservationRange, Request, Verdict
from viskill_deploy.safety.supervisor import Supervisor


class Rehearsal:
    """Judges requests on invented states. No setpoint for a driver ever comes of it.

    Args:
        cell: the cell.
        period_s: time between two requests, s.
        training: what the policy has seen in training.
        speed: part of every speed limit that is left, in (0, 1].

    Attributes:
        margins: smallest margin to every rule so far, by id; 1.0 where it was far or not asked.
    """

    def __init__(
        self,
        cell: CellDescription,
        period_s: float,
        training: ObservationRange | None = None,
        speed: float = 1.0,
    ) -> None:
        self._gate = Supervisor(cell, period_s, training, speed)
        self.margins = dict.fromkeys(self._gate.rules, 1.0)

    def begin(self, refused: CellState, agreed: CellState, now: float) -> tuple[Verdict, ...]:
        """Why the gate would not arm; empty when it would.

        Args:
            refused: the cell at its start, without consent.
            agreed: the same with it.
            now: clock of the rehearsal, s.
        """
        self._gate.connect(refused)
        return self._gate.arm(agreed, now)

    def judge(self, state: CellState, request: Request, now: float) -> tuple[Verdict, ...]:
        """What the gate would say of one cycle."""
        decision = self._gate.check(state, request, now)
        for rule, margin in zip(self._gate.rules, decision.margins, strict=True):
            # a margin that is no number counts as broken, or it would be forgotten
            self.margins[rule] = min(self.margins[rule], -1.0 if isnan(margin) else margin)
        return decision.verdicts
