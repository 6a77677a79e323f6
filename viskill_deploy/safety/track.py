"""What one arm was last sent, how that moved, and what is asked of it now."""

from __future__ import annotations

from collections import deque
from math import ceil, dist
from operator import mul, sub

from viskill_deploy.core.types import Joints, JointSetpoint
from viskill_deploy.safety.envelope import ROUNDING, ArmEnvelope
from viskill_deploy.safety.geometry import Point
from viskill_deploy.safety.stopping import ArmStop, CommonStop, JointStop, Motion

OLDEST_S = 0.1
"""Feedback of this age is a fault by itself (S18): what was sent before that needs no keeping."""
JERK_ROUNDING = 1e-7
"""Relative width of the jerk limits: third differences of positions at 1 kHz carry 2e-8 of them."""
LEAP = 100.0
"""Parts of full speed beyond which no rule asks where a setpoint would lead: S05 and S08 hold it,
and what follows from such numbers overflows."""
NOWHERE: Point = (0.0, 0.0, 0.0)


class ArmTrack:
    """One arm's motion by differences of what was really sent; mutable. `begin` comes first.

    Speeds and accelerations come from the nominal period: setpoints are samples of one time base,
    whatever the jitter of the loop (S05 watches true time over a window).

    Attributes:
        index: of the arm in the cell.
        envelope: what it may do.
        sent: the last setpoint that went out; `recent` holds those that its driver may still
            report, newest last, and `latency` is how far behind it may be with a new sample, s.
        q: positions of what was sent, (n,) with the jaw last.
        step, bend: first and second difference of `q` over the last periods: speed times period,
            acceleration times period squared.
        point, jaw_end: control point and jaw end at `q`, task frame, m; `points` are the ends of
            all its parts.
        asked, asked_q, …: the same for what is asked in this cycle.
        speed, acceleration, jerk: what is asked as a part of the limit, (n,), never negative.
        fastest, sharpest, jerkiest: largest speed of the joints, largest acceleration and largest
            jerk of all axes.
        point_speed: speed of the control point, m/s.
    """

    __slots__ = (
        "_per_full_bend",
        "_per_full_jerk",
        "_per_full_step",
        "_rate",
        "acceleration",
        "asked",
        "asked_bend",
        "asked_jaw_end",
        "asked_point",
        "asked_points",
        "asked_q",
        "asked_step",
        "bend",
        "envelope",
        "fastest",
        "index",
        "jaw_end",
        "jerk",
        "jerkiest",
        "latency",
        "point",
        "point_speed",
        "points",
        "q",
        "recent",
        "sent",
        "sharpest",
        "speed",
        "step",
    )

    speed: list[float]
    acceleration: list[float]
    jerk: list[float]

    def __init__(self, index: int, envelope: ArmEnvelope, period: float) -> None:
        self.index, self.envelope = index, envelope
        self._rate = 1.0 / period
        unit, unit_2 = (1.0 - ROUNDING) / period, (1.0 - ROUNDING) / period**2
        self._per_full_step = [unit / x for x in envelope.max_speed]
        self._per_full_bend = [unit_2 / x for x in envelope.max_acceleration]
        self._per_full_jerk = [(1.0 - JERK_ROUNDING) / period**3 / x for x in envelope.max_jerk]
        self.latency = 2.0 * max(period, envelope.feedback_period)
        self.recent: deque[JointSetpoint] = deque(
            maxlen=1 + ceil((self.latency + OLDEST_S) / period)
        )

    def begin(self, setpoint: JointSetpoint) -> None:
        """Starts a record at rest, at what the driver holds."""
        self.q = self.asked_q = (*setpoint.jp, setpoint.jaw)
        self.step: list[float] = [0.0] * len(self.q)
        self.bend: list[float] = [0.0] * len(self.q)
        self.points = self.envelope.chain.points(self.q)
        self.point, self.jaw_end, _, _ = self.points
        self.sent = setpoint
        self.recent.clear()
        self.recent.append(setpoint)
        self.ask(setpoint)

    def ask(self, setpoint: JointSetpoint) -> None:
        """Works out once what the rules need to know about a sound setpoint."""
        self.asked = setpoint
        q = self.asked_q = (*setpoint.jp, setpoint.jaw)
        step = self.asked_step = list(map(sub, q, self.q))
        bend = self.asked_bend = list(map(sub, step, self.step))
        self.speed = list(map(mul, map(abs, step), self._per_full_step))
        self.acceleration = list(map(mul, map(abs, bend), self._per_full_bend))
        self.jerk = list(map(mul, map(abs, map(sub, bend, self.bend)), self._per_full_jerk))
        self.fastest = max(self.speed[:-1])
        self.sharpest = max(self.acceleration)
        self.jerkiest = max(self.jerk)
        self.asked_points = self.envelope.chain.points(q)
        self.asked_point, self.asked_jaw_end, _, _ = self.asked_points
        self.point_speed = dist(self.asked_point, self.point) * self._rate

    def accept(self) -> None:
        """What was asked has gone out."""
        self.sent = self.asked
        self.q, self.step, self.bend = self.asked_q, self.asked_step, self.asked_bend
        self.points = self.asked_points
        self.point, self.jaw_end = self.asked_point, self.asked_jaw_end
        self.recent.append(self.asked)

    def asked_motion(self, joint: int) -> Motion:
        """Position, speed and acceleration of one joint at the setpoint that is asked."""
        return self._motion(self.asked_q[joint], self.asked_step[joint], self.asked_bend[joint])

    def _motion(self, q: float, step: float, bend: float) -> Motion:
        """A difference is the speed half a period ago; constant acceleration carries it to now."""
        return q, (step + 0.5 * bend) * self._rate, bend * self._rate * self._rate

    def stop(self) -> ArmStop | CommonStop:
        """The gate's own stop from the last setpoint sent."""
        envelope = self.envelope
        motions = map(self._motion, self.q, self.step, self.bend)
        kind = ArmStop if envelope.has_remote_centre else CommonStop
        return kind(motions, envelope.max_acceleration, envelope.max_jerk)

    def asked_extent(self, joint: int) -> tuple[float, float]:
        """Bounds of one joint's positions in the gate's stop from what is asked."""
        if self.envelope.has_remote_centre:
            return self._asked_stop(joint).extent()
        return self._asked_common_stop().extent(joint)

    def asked_end(self) -> Joints:
        """Where the gate's stop from what is asked brings the joints."""
        if self.envelope.has_remote_centre:
            return tuple([self._asked_stop(joint).end for joint in range(len(self.q) - 1)])
        return self._asked_common_stop().end

    def _asked_stop(self, joint: int) -> JointStop:
        arm = self.envelope
        return JointStop(
            *self.asked_motion(joint), arm.max_acceleration[joint], arm.max_jerk[joint]
        )

    def _asked_common_stop(self) -> CommonStop:
        arm = self.envelope
        motions = map(self._motion, self.asked_q, self.asked_step, self.asked_bend)
        return CommonStop(motions, arm.max_acceleration, arm.max_jerk)
