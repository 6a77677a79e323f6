"""All that the rules may look at in one cycle, gathered once."""

from __future__ import annotations

import math

from viskill_deploy.core.types import CellState, Request, Verdict
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.track import ArmTrack


class Cycle:
    """One cycle, refilled in place: nothing is allocated on a quiet cycle.

    Attributes:
        envelope: thresholds of the cell.
        tracks: one an arm.
        state, request: what the supervisor was given; trust their numbers only in rules that need
            a sound state or a sound request.
        now: driver's clock, never going back; `given_now` is what the caller said.
        dt: time since the last cycle, s; one period in the first one.
        is_first: no setpoint has passed since the cell was armed or resumed.
        is_stopping: the gate sends its own stop, so the request is not going out anyway.
        reports: what others have reported to the supervisor since the last cycle.
        stopped_before: ids of rules that have ended an earlier run of this supervisor.
    """

    __slots__ = (
        "dt",
        "envelope",
        "given_now",
        "is_first",
        "is_stopping",
        "now",
        "reports",
        "request",
        "state",
        "stopped_before",
        "tracks",
    )

    def __init__(self, envelope: CellEnvelope) -> None:
        self.envelope = envelope
        self.tracks = tuple(
            ArmTrack(index, arm, envelope.period) for index, arm in enumerate(envelope.arms)
        )
        self.now = self.given_now = -math.inf
        self.dt: float
        self.is_first, self.is_stopping = True, False
        self.reports: tuple[Verdict, ...] = ()
        self.stopped_before: frozenset[str] = frozenset()
        self.request: Request
        self.state: CellState

    def begin(self, state: CellState, request: Request, now: float) -> None:
        """Takes in what the supervisor was given; a clock that goes back is not followed."""
        self.state, self.request, self.given_now = state, request, now
        if self.is_first:
            self.dt = self.envelope.period
        elif now >= self.now:
            self.dt = now - self.now
        if math.isfinite(now):
            self.now = max(self.now, now)
