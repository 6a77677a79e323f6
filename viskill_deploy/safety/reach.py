"""How far an arm can still travel once the gate stops it: a bound, cheaper than the stop itself."""

from __future__ import annotations

from math import sqrt
from operator import mul

from viskill_deploy.safety.envelope import ArmEnvelope
from viskill_deploy.safety.stopping import CLOCK_BRAKES, CLOCK_BUILDS_UP_S, LONGER, SHARE
from viskill_deploy.safety.track import ArmTrack


class Reach:
    """No stop of a joint from speed v and acceleration a is longer than w (|a|/J + w/2A + A/2J).

    There w = |v| + a^2 / 2J, and a reversal is included: |a| / J passes at no more than w, and the
    rest is the way from speed w, where the trapezoid bounds the triangle. Speeds and accelerations
    are parts of their limits, and every coefficient is the largest of all joints.

    A `CommonStop` takes no longer, and its clock goes no farther, than twice 1/B + 2 B/C, where B
    is how a clock brakes that starts evenly and C how fast it begins to. The bend of its path is a
    part of the acceleration, no longer than all joints' together: sqrt(n) times the sharpest.

    Args:
        arm: its limits and lengths.
        period: control period, s.
        has_jaw: whether `travel` includes the jaw's end.
    """

    __slots__ = (
        "_brake",
        "_full",
        "_is_psm",
        "_lag",
        "_least",
        "_offset",
        "_period",
        "_push",
        "_rise",
        "_root",
        "_shift",
    )

    def __init__(self, arm: ArmEnvelope, period: float, has_jaw: bool = False) -> None:
        rows = list(zip(arm.max_speed[:-1], arm.max_acceleration, arm.max_jerk, strict=False))
        self._is_psm = arm.has_remote_centre
        self._period = period
        self._shift = max(0.5 * period * a / v for v, a, _ in rows)
        self._rise = max(0.5 * a * a / (j * v) for v, a, j in rows)
        self._root = sqrt(len(rows))
        self._lag = max(a / j for _, a, j in rows)
        self._brake = max(0.5 * v / a for v, a, _ in rows)
        self._least = 1.0 / CLOCK_BRAKES + 2.0 * max(self._lag, CLOCK_BUILDS_UP_S)
        jaw = arm.jaw_length if has_jaw else 0.0
        tail = arm.wrist_length + jaw
        self._offset = arm.wrist_offset + tail
        levers = arm.levers or (1.0, 1.0, 1.0, tail, tail, jaw)
        self._full = [v * lever for (v, _, _), lever in zip(rows, levers, strict=True)]
        self._push = [0.5 * a * lever for (_, a, _), lever in zip(rows, levers, strict=True)]

    def speed_and_time(self, speed: float, acceleration: float) -> tuple[float, float]:
        """The largest w, as a part of full speed, and the time at w that no stop is longer than."""
        if not self._is_psm:
            time = self._common_time(speed, acceleration)
            bend = self._root * self._shift * time / self._period
            return speed + acceleration * (self._shift + bend), time
        w = speed + acceleration * (self._shift + acceleration * self._rise)
        return w, self._lag * (acceleration + 0.5) + w * self._brake

    def travel(self, track: ArmTrack) -> float:
        """Way that no point from the port to the jaw exceeds in a stop from what is asked, m."""
        if not self._is_psm:
            return self._travel_of_all(track)
        f0, f1, f2, f3, f4, f5, _ = track.speed
        s0, s1, s2, s3, s4, s5, _ = track.acceleration
        v0, v1, v2, v3, v4, v5 = self._full
        a0, a1, a2, a3, a4, a5 = self._push
        sharpest = max(s0, s1, s2, s3, s4, s5)
        bend = self._period + self._lag * sharpest
        _, time = self.speed_and_time(track.fastest, sharpest)
        slide = time * (v2 * f2 + bend * a2 * s2)
        swing = time * (v0 * f0 + v1 * f1 + bend * (a0 * s0 + a1 * s1))
        turn = v3 * f3 + v4 * f4 + v5 * f5 + bend * (a3 * s3 + a4 * s4 + a5 * s5)
        return slide + (self._offset + track.asked_q[2] + slide) * swing + time * turn

    def _common_time(self, speed: float, acceleration: float) -> float:
        """The longest that a `CommonStop` takes, s."""
        speed += acceleration * self._shift
        brakes = 2.0 * self._brake * speed + 6.0 * self._lag * acceleration
        return LONGER * (self._least + brakes / SHARE)

    def _travel_of_all(self, track: ArmTrack) -> float:
        """The same where every joint moves all that is behind it."""
        sharpest = max(track.acceleration[:-1])
        time = self._common_time(track.fastest, sharpest)
        speeds: float = sum(map(mul, self._full, track.speed))
        push = sharpest * sum(self._push)
        return time * (speeds + (self._period + self._root * time) * push)
