"""The gate's own stop: every joint to rest, jerk-limited, in the shortest time.

Plain Python, no other library, so that nothing outside this folder can keep the arm moving. The
profile is the textbook one (Biagiotti and Melchiorri, Trajectory Planning for Automatic Machines
and Robots, 2008, ch. 3): jerk to the braking acceleration, hold it, jerk back to zero at zero
speed. For a joint that moves one way it is also the shortest way to rest, hence the best that can
be done about a position limit ahead.
"""

from __future__ import annotations

from collections.abc import Iterable
from math import sqrt

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
        for _, p, v, a, jerk in self.phases[:1]:
            places.append(p)
            # Speed and acceleration of opposite sign, and so much acceleration that it must turn:
            # the turning point solves v + a t + jerk t^2 / 2 = 0 (smaller root).
            if v * a < 0.0 and a * jerk < 0.0 and a * a >= 2.0 * jerk * v:
                turn = -2.0 * v / (a + _sign(a) * sqrt(a * a - 2.0 * jerk * v))
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
    meanwhile. Here the arm runs out along its present velocity, q + v s(t), and its present
    acceleration dies away along itself, a u(t): both keep the shaft in the port up to the square
    of a way of millirads. Each gets half of every joint's acceleration and jerk.

    Attributes:
        duration_s: time until rest.
    """

    __slots__ = ("_along", "_bend", "_jaw", "_motions", "duration_s")

    def __init__(
        self, motions: Iterable[Motion], max_acceleration: Joints, max_jerk: Joints
    ) -> None:
        """Plans the stop; arguments as those of `ArmStop`."""
        *joints, jaw = motions
        self._motions = tuple(joints)
        self._jaw = JointStop(*jaw, max_acceleration[-1], max_jerk[-1])
        limits = (max_acceleration, max_jerk)
        self._along = _unit_stop((1.0, 0.0), [v for _, v, _ in joints], *limits)
        self._bend = _unit_stop((0.0, 1.0), [a for _, _, a in joints], *limits)
        self.duration_s = max(self._along.duration_s, self._bend.duration_s, self._jaw.duration_s)

    @property
    def end(self) -> Joints:
        """Where the joints come to rest."""
        s, u = self._along.end, self._bend.end
        return tuple([p + v * s + a * u for p, v, a in self._motions])

    def extent(self, joint: int) -> tuple[float, float]:
        """Bounds of one joint's positions on the way."""
        p, v, a = self._motions[joint]
        ways = v * self._along.end, a * self._bend.end
        return p + sum([min(way, 0.0) for way in ways]), p + sum([max(way, 0.0) for way in ways])

    def at(self, t: float) -> JointSetpoint:
        """The setpoint `t` seconds after the start of the stop."""
        (s, s_rate, _), (u, u_rate, _) = self._along.at(t), self._bend.at(t)
        jaw, jaw_v, _ = self._jaw.at(t)
        positions = tuple([p + v * s + a * u for p, v, a in self._motions])
        speeds = tuple([v * s_rate + a * u_rate for _, v, a in self._motions])
        return JointSetpoint(positions, speeds, jaw, jaw_v)


SHARE = 0.5
"""Part of an arm's acceleration and jerk that each half of a `CommonStop` may use."""


def _unit_stop(
    start: tuple[float, float], parts: list[float], max_acceleration: Joints, max_jerk: Joints
) -> JointStop:
    """The stop of a factor that multiplies `parts`, joint by joint, within half of each limit."""
    pairs = [
        (SHARE * a / abs(part), SHARE * j / abs(part))
        for part, a, j in zip(parts, max_acceleration, max_jerk, strict=False)
        if part != 0.0
    ]
    if not pairs:
        return JointStop(0.0, 0.0, 0.0, 1.0, 1.0)
    accelerations, jerks = zip(*pairs, strict=True)
    return JointStop(0.0, *start, min(accelerations), min(jerks))


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
        return [(abs(a) / max_jerk, -_sign(a) * max_jerk)] if a else []
    side = _sign(left)
    v, a, jerk = side * v, side * a, side * max_jerk  # from here on: brake a positive speed
    # Without a piece of constant acceleration: (a^2 - 2 peak^2) / (2 J) = -v.
    peak = min(sqrt(max(max_jerk * v + a * a / 2.0, 0.0)), max_acceleration)
    if a < -peak:
        rise = (-peak - a) / max_jerk
        hold = side * left / peak
        return [(rise, jerk), (hold, 0.0), (peak / max_jerk, jerk)]
    hold = max((v + (a * a - 2.0 * peak * peak) / (2.0 * max_jerk)) / peak, 0.0)
    return [((a + peak) / max_jerk, -jerk), (hold, 0.0), (peak / max_jerk, jerk)]


def advance(p: float, v: float, a: float, jerk: float, t: float) -> Motion:
    """Motion after `t` seconds of constant jerk."""
    return (
        p + t * (v + t * (a / 2.0 + t * jerk / 6.0)),
        v + t * (a + t * jerk / 2.0),
        a + t * jerk,
    )


def _sign(x: float) -> float:
    return -1.0 if x < 0.0 else 1.0
