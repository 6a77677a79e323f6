"""The setpoints that a guard's client sends, gathered into what the gate is asked in one cycle."""

from __future__ import annotations

from collections.abc import Sequence
from math import dist, hypot, inf, isfinite
from typing import Final

from viskill_deploy.core.errors import KinematicsError
from viskill_deploy.core.types import JointSetpoint, Request
from viskill_deploy.drivers.crtk.offered_arm import Asked, OfferedArm

TOGETHER_S: Final = 0.001
"""What the arms of one moment are sent arrives within this."""

AWAITED: Final = 1.5
"""Periods for which the setpoint of a moving arm or jaw is waited for when others' have come:
programs that move an arm each keep no step, and one that is left out would stop at once."""

LOST: Final = 3
"""Periods without a setpoint, while the arms move, after which the stream counts as broken off."""

STILL: Final = 1e-9
"""rad or m in a period: where arms are this still, nobody can tell that a setpoint is missing."""

EARLY: Final = 4
"""Setpoints that may come before their time, such as after a wait for a processor."""

FAST: Final = 1.05
"""How much faster than it was said to be a client may be for ever: no two clocks are the same."""

Setpoints = tuple[JointSetpoint, ...]


class ClientStream:
    """What a client asks of all arms of a cell, cycle by cycle.

    Args:
        arms: what it sees of the cell.
        period_s: time between two setpoints of the client.
        max_jerk: of each arm's joints and jaw, (7,) each, rad/s^3 or m/s^3.

    Attributes:
        sent: what the arms were sent last.
    """

    def __init__(
        self, arms: Sequence[OfferedArm], period_s: float, max_jerk: Sequence[Sequence[float]]
    ) -> None:
        self._arms, self._period_s = arms, period_s
        # Half of the way in a period that the gate lets end at once.
        self._still = [[0.5 * jerk * period_s**3 for jerk in arm] for arm in max_jerk]
        self._free = (True,) * len(arms)  # a jaw that opens is the client's wish
        self.begin(())

    def begin(self, held: Setpoints) -> None:
        """Starts at rest, at what the arms hold; what waits is of before."""
        self.sent, self._way = held, 0.0
        self._expected = self._moving = 0
        self._due_s = -inf  # when the next setpoint of a client that keeps its rate would come
        self.forget()

    @property
    def is_moving(self) -> bool:
        """Whether the arms went too far in the last cycle to be at rest in the next."""
        return self._moving > 0

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
        return waiting & self._expected == self._expected or now >= self.together_s

    @property
    def together_s(self) -> float:
        """Until when the rest of what has begun to come is waited for, driver's clock."""
        missing = self._expected & self._moving & ~self._waiting()
        wait_s = AWAITED * self._period_s if missing else TOGETHER_S
        return min([at for arm in self._arms for at in arm.arrivals], default=-inf) + wait_s

    @property
    def patience_s(self) -> float:
        """How long the gate waits for the next setpoint before it looks anyway."""
        return (LOST if self.is_moving else 1) * self._period_s

    def forget(self) -> None:
        """Drops what waits."""
        for arm in self._arms:
            arm.forget()

    def requests(self, halt: str, now: float) -> list[Request]:
        """What the gate is asked, in order: what was lost on the way, and what has come.

        Args:
            halt: why the arms have to come to rest; "" when they have not.
            now: driver's clock, s.
        """
        waiting = self._waiting()
        if halt or (not waiting and self.is_moving):
            return self._stop(halt or "the client's stream has broken off")
        self._expected = waiting
        try:
            requests = self._asked()
        except KinematicsError as error:
            return self._stop(str(error))
        if self._is_early(len(requests), now):
            rate = f"{1.0 / self._period_s:g}"
            return self._stop(f"more than {rate} setpoints a second; start the guard with --rate")
        return requests

    def note(self, sent: Setpoints) -> None:
        """Remembers what has passed."""
        self._way, self._moving = 0.0, 0
        for a, b, still in zip(self.sent, sent, self._still, strict=True):
            here, there = (*a.jp, a.jaw), (*b.jp, b.jaw)
            self._way += dist(here, there)
            *joints, jaw = [abs(y - x) > s for x, y, s in zip(here, there, still, strict=True)]
            self._moving = self._moving << 2 | any(joints) << 1 | jaw
        self.sent = sent

    def _stop(self, why: str) -> list[Request]:
        """What waits is not looked at any more."""
        self.forget()
        return [Request(None, failure=why)]

    def _is_early(self, count: int, now: float) -> bool:
        """Whether so many more are too many for the time that has passed.

        The gate takes one after the other for a period apart. Moving arms would go faster than it
        can see if they came faster.
        """
        due_s = max(self._due_s, now) if self.is_moving else now
        self._due_s = due_s + count * self._period_s / FAST
        return self._due_s > now + (EARLY + 1) * self._period_s

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
