"""The setpoints that a guard's client sends, gathered into what the gate is asked in one cycle."""

from __future__ import annotations

from collections.abc import Sequence
from math import dist, hypot, isfinite
from typing import Final

from viskill_deploy.core.errors import KinematicsError
from viskill_deploy.core.types import JointSetpoint, Request
from viskill_deploy.drivers.crtk.offered_arm import Asked, OfferedArm

TOGETHER_S: Final = 0.001
"""What the arms of one moment are sent arrives within this."""

LOST: Final = 3
"""Periods without a setpoint, while the arms move, after which the stream counts as broken off."""

STILL: Final = 1e-9
"""rad or m in a period."""

Setpoints = tuple[JointSetpoint, ...]


class ClientStream:
    """What a client asks of all arms of a cell, cycle by cycle.

    Args:
        arms: what it sees of the cell.
        period_s: time between two setpoints of the client.

    Attributes:
        sent: what the arms were sent last.
    """

    def __init__(self, arms: Sequence[OfferedArm], period_s: float) -> None:
        self._arms, self._period_s = arms, period_s
        self._free = (True,) * len(arms)  # a jaw that opens is the client's wish
        self.begin(())

    def begin(self, held: Setpoints) -> None:
        """Starts at rest, at what the arms hold; what waits is of before."""
        self.sent, self._way = held, 0.0
        self._expected = 0
        self.forget()

    @property
    def is_moving(self) -> bool:
        """Whether the arms went anywhere in the last cycle."""
        return self._way > STILL

    @property
    def is_waiting(self) -> bool:
        """Whether anything has come that was not looked at."""
        return self._waiting() > 0

    def is_due(self, now: float, since_s: float) -> bool:
        """Whether the gate has to look: all of one moment is there, or time is up.

        Args:
            now: driver's clock, s.
            since_s: time since it looked last.
        """
        waiting = self._waiting()
        if not waiting:
            return since_s >= self.patience_s
        if waiting & self._expected == self._expected:
            return True
        return now >= min([at for arm in self._arms for at in arm.arrivals]) + TOGETHER_S

    @property
    def patience_s(self) -> float:
        """How long the gate waits for the next setpoint before it looks anyway."""
        return (LOST if self.is_moving else 1) * self._period_s

    def forget(self) -> None:
        """Drops what waits."""
        for arm in self._arms:
            arm.forget()

    def requests(self, halt: str) -> list[Request]:
        """What the gate is asked, in order: what was lost on the way, and what has come.

        Args:
            halt: why the arms have to come to rest; "" when they have not.
        """
        waiting = self._waiting()
        if halt or (not waiting and self.is_moving):
            self.forget()
            return [Request(None, failure=halt or "the client's stream has broken off")]
        self._expected = waiting
        try:
            return self._asked()
        except KinematicsError as error:
            self.forget()
            return [Request(None, failure=str(error))]

    def note(self, sent: Setpoints) -> None:
        """Remembers what has passed."""
        pairs = zip(self.sent, sent, strict=True)
        self._way = sum([dist((*a.jp, a.jaw), (*b.jp, b.jaw)) for a, b in pairs])
        self.sent = sent

    def _waiting(self) -> int:
        """Which streams have a setpoint that waits: two bits an arm, joints above jaw."""
        waiting = 0
        for arm in self._arms:
            waiting = waiting << 2 | bool(arm.servo) << 1 | bool(arm.jaw)
        return waiting

    def _asked(self) -> list[Request]:
        pairs = zip(self._arms, self.sent, strict=True)
        asked = [arm.take(last, self._period_s) for arm, last in pairs]
        missing = self._missing(asked)
        if missing >= LOST:
            return [Request(None, failure=f"{missing} setpoints of the client were lost")]
        n, time_s = missing + 1, (missing + 1) * self._period_s
        taken = [a.setpoint(last, time_s) for a, last in zip(asked, self.sent, strict=True)]
        requests = [Request(tuple(taken), may_open_jaw=self._free)]
        if missing:
            ends = list(zip(self.sent, taken, strict=True))
            rows = [tuple([_between(a, b, k / n, time_s) for a, b in ends]) for k in range(1, n)]
            requests[:0] = [Request(row, may_open_jaw=self._free) for row in rows]
        return requests

    def _missing(self, asked: Sequence[Asked]) -> int:
        """How many setpoints of a moving client were lost: its stamps and its way both say so.

        The stamps of a client that wakes late have gaps as well, but it goes no farther for that.
        """
        before, lost = self._way, max([a.lost for a in asked])
        if not lost:
            return 0
        way = sum([a.way(last) for a, last in zip(asked, self.sent, strict=True)])
        if not (before > STILL and isfinite(way)):
            return 0
        after = sum([hypot(*a.jv, *a.jaw_v) for a in asked]) * self._period_s or before
        periods = round(2.0 * way / (before + after)) if isfinite(after) else 1
        return max(min(lost, periods - 1), 0)


def _between(a: JointSetpoint, b: JointSetpoint, part: float, time_s: float) -> JointSetpoint:
    """What lay between two setpoints of a stream: cubics by their positions and velocities.

    Args:
        a: the earlier one.
        b: the later one.
        part: how far between them, 0 to 1.
        time_s: time from one to the other.
    """
    s, r = part, 1.0 - part
    rising, first, second = s * s * (3.0 - 2.0 * s), s * r * r * time_s, -s * s * r * time_s

    def cubic(x: float, y: float, v: float, w: float) -> float:
        return x + rising * (y - x) + first * v + second * w

    jp = tuple(map(cubic, a.jp, b.jp, a.jv, b.jv))
    return JointSetpoint(jp, b.jv, cubic(a.jaw, b.jaw, a.jaw_v, b.jaw_v), b.jaw_v)
