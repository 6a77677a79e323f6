"""The setpoints that a guard's client sends, gathered into what the gate is asked in one cycle."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isfinite
from typing import Final

from viskill_deploy.core.errors import KinematicsError
from viskill_deploy.core.types import JointSetpoint, Request
from viskill_deploy.drivers.crtk.offered_arm import Asked, OfferedArm

TOGETHER_S: Final = 0.001
"""What the arms of one moment are sent arrives within this."""

LOST: Final = 3
"""Periods without a setpoint, while the arms move, after which the stream counts as broken off."""

AWAITED: Final = 2.5
"""Periods after the last look for which an arm or a jaw in motion is waited for when others' have
come: programs that move an arm each keep no step, and one that is left out would stop at once. So
long, too, a motion that is slow enough to end may take to go on: at a turn, or where it begins."""

AXES: Final = 7
"""Joints of an arm, and its jaw."""

STILL: Final = 1e-9
"""rad or m in a period: less is rest."""

EARLY: Final = 4
"""Setpoints that may come before their time."""

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
        # How far from where the last cycles lead the gate lets each joint go in a period.
        self._free_way = [jerk * period_s**3 for arm in max_jerk for jerk in arm]
        self._free = (True,) * len(arms)  # a jaw that opens is the client's wish
        self.begin(())

    def begin(self, held: Setpoints) -> None:
        """Starts at rest, at what the arms hold; what waits is of before."""
        self.sent, self._is_slow = held, True
        self._steps = self._bends = [0.0] * len(self._free_way)  # of the last cycle
        self._before = self._expected = self._moving = 0
        self._due_s = -inf  # when the next setpoint of a client that keeps its rate would come
        self.forget()

    @property
    def is_moving(self) -> bool:
        """Whether the arms went anywhere in the last cycle."""
        return self._moving > 0

    @property
    def is_waiting(self) -> bool:
        """Whether anything has come that was not looked at."""
        return self._waiting() > 0

    def due_s(self, last_s: float) -> float:
        """When the gate has to look if nothing more comes; at once when all of one moment is there.

        Args:
            last_s: when it looked last, driver's clock.
        """
        waiting = self._waiting()
        if not waiting:
            periods = 1 if not self.is_moving else AWAITED if self._is_slow else LOST
            return last_s + periods * self._period_s
        missing = self._expected & ~waiting
        if not missing:
            return -inf
        if missing & self._moving:
            return last_s + AWAITED * self._period_s
        return min([at for arm in self._arms for at in arm.arrivals]) + TOGETHER_S

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
        if halt or not (waiting or self._is_slow):
            return self._stop(halt or "the client's stream has broken off")
        self._before, self._expected = waiting, waiting | self._before
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
        here = _joints(self.sent)
        steps = [new - old for new, old in zip(_joints(sent), here, strict=True)]
        self._bends = [new - old for new, old in zip(steps, self._steps, strict=True)]
        self._steps, self._moving = steps, 0
        moves = [abs(step) > STILL for step in steps]
        for first in range(0, len(moves), AXES):
            joints, jaw = any(moves[first : first + AXES - 1]), moves[first + AXES - 1]
            self._moving = self._moving << 2 | joints << 1 | jaw
        pairs = zip(steps, self._free_way, strict=True)
        self._is_slow = all(abs(step) <= 0.5 * most for step, most in pairs)
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
        behind_s = LOST * self._period_s  # what waited for a processor may come at once
        due_s = max(self._due_s, now - behind_s) if self.is_moving else now
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
        lost = max([a.lost for a in asked])
        if not (lost and self.is_moving):
            return 0
        there = [x for a in asked for x in (*a.jp, a.jaw)]
        if not all(map(isfinite, there)):
            return 0
        doubts = [self._doubt(there, periods) for periods in range(1, min(lost, LOST) + 2)]
        return 0 if doubts[0] <= 1.0 else doubts.index(min(doubts))

    def _doubt(self, there: Sequence[float], periods: int) -> float:
        """How far from there a motion as the last cycles' leads in so many periods; 1.0 passes."""
        bent = 0.5 * periods * (periods + 1)
        rows = zip(there, _joints(self.sent), self._steps, self._bends, self._free_way, strict=True)
        return max([abs(y - x - periods * s - bent * b) / most for y, x, s, b, most in rows])


def _joints(setpoints: Setpoints) -> list[float]:
    """All joints and jaws, one arm after the other."""
    return [x for s in setpoints for x in (*s.jp, s.jaw)]


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
