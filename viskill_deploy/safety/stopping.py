"""The gate's own stop: every joint to rest, jerk-limited, in the shortest time.

Plain Python, no other library, so that nothing outside this folder can keep the arm moving. The
profile is the textbook one (Biagiotti and Melchiorri, Trajectory Planning for Automatic Machines
and Robots, 2008, ch. 3): jerk to the braking acceleration, hold it, jerk back to zero at zero
speed. For a joint that moves one way it is also the shortest way to rest, hence the best that can
be done about a position limit ahead.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import copysign, sqrt

from viskill_deploy.core.types import Joints, JointSetpoint

Motion = tuple[float, float, float]
"""Position, speed, acceleration."""
Piece = tuple[float, float]
"""Duration in s and jerk."""


class JointStop:
    """One joint's way to rest.

    Attributes:
        phases: (start time, position, speed, acceleration, jerk) of each piece.
        duration_s: time until rest.
        end: position at rest.
    """

    __slots__ = ("duration_s", "end", "phases")

    def __init__(
        self, p: float, v: float, a: float, max_acceleration: float, max_jerk: float
    ) -> None:
        phases: list[tuple[float, float, float, float, float]] = []
        t = 0.0
        for duration, jerk in braking(v, a, max_acceleration, max_jerk):
            phases.append((t, p, v, a, jerk))
            p, v, a = advance(p, v, a, jerk, duration)
            t += duration
        self.phases = tuple(phases)
        self.duration_s = t
        self.end = p

    def at(self, t: float) -> Motion:
        """Position, speed and acceleration `t` seconds after the start of the stop."""
        if t < self.duration_s:
            start, p, v, a, jerk = [phase for phase in self.phases if phase[0] <= t][-1]
            return advance(p, v, a, jerk, t - start)
        return self.end, 0.0, 0.0

    def extent(self) -> tuple[float, float]:
        """Smallest and largest position on the way, a reversal included."""
        places = [self.end]
        if self.phases:
            _, p, v, a, jerk = self.phases[0]
            places.append(p)
            # Speed and acceleration of opposite sign, and so much acceleration that it must turn:
            # the turning point solves v + a t + jerk t^2 / 2 = 0 (smaller root).
            if v * a < 0.0 and a * a >= 2.0 * jerk * v:
                turn = -2.0 * v / (a + copysign(sqrt(a * a - 2.0 * jerk * v), a))
                places.append(advance(p, v, a, jerk, turn)[0])
        return min(places), max(places)


class ArmStop:
    """One arm's way to rest: joints and jaw, each as fast as it can.

    Attributes:
        duration_s: time until the last of them rests.
    """

    __slots__ = ("_joints", "duration_s")

    def __init__(
        self, motions: Iterable[Motion], max_acceleration: Joints, max_jerk: Joints
    ) -> None:
        """Plans the stop.

        Args:
            motions: position, speed, acceleration of the joints and the jaw.
            max_acceleration: a limit each, rad/s^2 or m/s^2.
            max_jerk: a limit each, rad/s^3 or m/s^3.
        """
        self._joints = tuple(
            JointStop(*motion, acceleration, jerk)
            for motion, acceleration, jerk in zip(motions, max_acceleration, max_jerk, strict=True)
        )
        self.duration_s = max(joint.duration_s for joint in self._joints)

    def at(self, t: float) -> JointSetpoint:
        """The setpoint `t` seconds after the start of the stop."""
        positions, speeds, _ = zip(*[joint.at(t) for joint in self._joints], strict=True)
        return JointSetpoint(positions[:-1], speeds[:-1], positions[-1], speeds[-1])


class CommonStop:
    """The way to rest of an arm that no mechanism keeps in its port: all joints under one clock.

    Joints that each stop as fast as they can stop at different times, and the shaft leaves the port
    meanwhile. Here time itself runs out: the arm goes on along its path as it bends now, q + v s +
    c s^2 / 2, while the rate of s falls from 1 to 0. The acceleration is split for that: what lies
    along the speed is the clock's, b = a v / v^2; the rest is the path's bend, c = a - b v, and a
    path that keeps the port bends with it. So the shaft leaves the port by no more than the cube of
    a short way.

    Attributes:
        duration_s: time until rest.
    """

    __slots__ = ("_clock", "_jaw", "_motions", "duration_s")

    def __init__(
        self, motions: Iterable[Motion], max_acceleration: Joints, max_jerk: Joints
    ) -> None:
        """Plans the stop; arguments as those of `ArmStop`."""
        *joints, jaw = motions
        self._jaw = JointStop(*jaw, max_acceleration[-1], max_jerk[-1])
        self._clock, self._motions = _clock_stop(joints, max_acceleration, max_jerk)
        self.duration_s = max(self._clock.duration_s, self._jaw.duration_s)

    @property
    def end(self) -> Joints:
        """Where the joints come to rest."""
        return self._at(self._clock.end)

    def extent(self, joint: int) -> tuple[float, float]:
        """Smallest and largest position of one joint on the way."""
        p, v, c = self._motions[joint]
        first, last = self._clock.extent()
        turn = -v / c if c else first
        ways = [s * (v + 0.5 * c * s) for s in (first, last, min(max(turn, first), last))]
        return p + min(ways), p + max(ways)

    def at(self, t: float) -> JointSetpoint:
        """The setpoint `t` seconds after the start of the stop."""
        s, rate, _ = self._clock.at(t)
        jaw, jaw_v, _ = self._jaw.at(t)
        speeds = tuple([(v + c * s) * rate for _, v, c in self._motions])
        return JointSetpoint(self._at(s), speeds, jaw, jaw_v)

    def _at(self, s: float) -> Joints:
        return tuple([p + s * (v + 0.5 * c * s) for p, v, c in self._motions])


SHARE = 0.5
"""Part of each joint's acceleration that braking the clock may use for its speed. Of its jerk,
(v + c s) C + 3 c B with B the clock's braking and C its jerk, either term may use as much; s is at
most 1 / 2B + B / C, which is why 4 c B and v + c / B stand below."""

CLOCK_BRAKES, CLOCK_BUILDS_UP_S = 25.0, 0.02
"""Per s: no clock stops in less than 40 ms, also that of an arm that hardly moves; and how soon
it brakes at full, s."""

LONGER = 2.0
"""A clock that starts with a rate that changes may take this many times as long, and go as far."""

TINY = 1e-9
"""A speed that is none."""


def _clock_stop(
    motions: list[Motion], max_acceleration: Joints, max_jerk: Joints
) -> tuple[JointStop, tuple[Motion, ...]]:
    """The stop of a clock from rate 1, as fast as the joints allow; position, v and c of each.

    Where the joints do not allow a clock whose rate changes from the beginning, such as at the very
    start of a motion, all of the acceleration counts as bend.
    """
    flat = _braking_clock(motions, 0.0, max_acceleration, max_jerk)
    rows = list(zip(motions, max_acceleration, strict=False))
    squared = sum([(v / most) ** 2 for (_, v, _), most in rows])
    along = sum([v * a / most**2 for (_, v, a), most in rows])
    change = along / max(squared, TINY)
    bent = [(p, v, a - change * v) for p, v, a in motions]
    clock = _braking_clock(bent, change, max_acceleration, max_jerk)
    way = max(map(abs, clock.extent()))
    longer = max(clock.duration_s / flat.duration_s, way / flat.end)
    if longer <= LONGER and _is_smooth(clock, bent, max_jerk):
        return clock, tuple(bent)
    return flat, tuple(motions)


def _braking_clock(
    motions: list[Motion], change: float, max_acceleration: Joints, max_jerk: Joints
) -> JointStop:
    """The stop from rate 1 that changes by `change` per s, for joints with speed and bend."""
    brake = CLOCK_BRAKES
    rows = list(zip(motions, max_acceleration, max_jerk, strict=False))
    for (_, v, c), most, jerk in rows:
        hardest = max(abs(v) / (SHARE * most), 4.0 * abs(c) / (SHARE * jerk))
        brake = min(brake, 1.0 / max(hardest, TINY))
    build_up = brake / CLOCK_BUILDS_UP_S
    for (_, v, c), _, jerk in rows:
        build_up = min(build_up, SHARE * jerk / max(abs(v) + abs(c) / brake, TINY))
    return JointStop(0.0, 1.0, change, brake, build_up)


def _is_smooth(clock: JointStop, motions: list[Motion], max_jerk: Joints) -> bool:
    """Whether no joint's jerk, (v + c s) s''' + 3 c s' s'', can exceed its limit."""
    states = [(v, a, jerk) for _, _, v, a, jerk in clock.phases]
    change = max([abs(a) for _, a, _ in states])
    jerk = max([abs(j) for _, _, j in states])
    rate = max([abs(v) for v, _, _ in states])
    way = max(map(abs, clock.extent()))
    return all(
        (abs(v) + abs(c) * way) * jerk + 3.0 * abs(c) * rate * change <= limit
        for (_, v, c), limit in zip(motions, max_jerk, strict=False)
    )


def braking(v: float, a: float, max_acceleration: float, max_jerk: float) -> list[Piece]:
    """(duration, jerk) of each piece that brings speed and acceleration to zero.

    Args:
        v: speed, rad/s or m/s.
        a: acceleration, rad/s^2 or m/s^2; may exceed the limit, it is then brought inside first.
        max_acceleration: limit, rad/s^2 or m/s^2.
        max_jerk: limit, rad/s^3 or m/s^3.
    """
    left = v + a * abs(a) / (2.0 * max_jerk)  # speed that remains if `a` went straight to zero
    if left == 0.0:
        return [(abs(a) / max_jerk, -copysign(max_jerk, a))] if a else []
    side = copysign(1.0, left)
    v, a, jerk = side * v, side * a, side * max_jerk  # from here on: brake a positive speed
    # Without a piece of constant acceleration: (a^2 - 2 peak^2) / (2 J) = -v.
    peak = min(sqrt(max(max_jerk * v + a * a / 2.0, 0.0)), max_acceleration)
    turn, rise = abs(a + peak) / max_jerk, peak / max_jerk  # to the peak, and from it to zero
    hold = max((v + 0.5 * (a - peak) * turn - 0.5 * peak * rise) / peak, 0.0)
    return [(turn, copysign(max_jerk, -jerk * (a + peak))), (hold, 0.0), (rise, jerk)]


def advance(p: float, v: float, a: float, jerk: float, t: float) -> Motion:
    """Motion after `t` seconds of constant jerk."""
    return (
        p + t * (v + t * (a / 2.0 + t * jerk / 6.0)),
        v + t * (a + t * jerk / 2.0),
        a + t * jerk,
    )
