"""A gate to try a plan on: it judges like the real one and lets nothing out."""

from __future__ import annotations

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import CellState, Request, Verdict
from viskill_deploy.safety.supervisor import Supervisor


class Rehearsal:
    """Judges requests on invented states. No setpoint for a driver ever comes of it.

    Args:
        cell: the cell.
        period_s: time between two requests, s.
    """

    def __init__(self, cell: CellDescription, period_s: float) -> None:
        self._gate = Supervisor(cell, period_s)

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
        return self._gate.check(state, request, now).verdicts
