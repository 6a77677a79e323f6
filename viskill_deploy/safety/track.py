"""What one arm was last sent, how that moved, and what is asked of it now."""

from __future__ import annotations

from collections import deque
from math import ceil, sqrt
from operator import mul

from viskill_deploy.core.types import Joints, JointSetpoint
from viskill_deploy.safety.envelope import ROUNDING, ArmEnvelope
from viskill_deploy.safety.geometry import Point
from viskill_deploy.safety.stopping import ArmStop, Motion

NOWHERE: Point = (0.0, 0.0, 0.0)
NO_JOINTS: Joints = (0.0,) * 7
NO_SETPOINT = JointSetpoint(NO_JOINTS[:6], NO_JOINTS[:6], 0.0, 0.0)


class ArmTrack:
    """One arm's motion by differences of what was really sent; mutable, one per run.

    Speeds and accelerations come from the nominal period: setpoints are samples of one time base,
    whatever the jitter of the loop (S05 watches true time over a window).

    Attributes:
        index: of the arm in the cell.
        envelope: what it may do.
        sent: the last setpoint that went out; `recent` holds those that its driver may still
            report, newest last.
        q, v, a: positions, speeds, accelerations of what was sent, (7,) with the jaw last.
        point, jaw_end: control point and jaw end at `q`, task frame, m.
        asked, asked_q, …: the same for what is asked in this cycle.
        speed, acceleration: what is asked as a part of the limit, (7,), never negative.
        point_speed: speed of the control point, m/s.
    """

    __slots__ = (
        "_inverse_acceleration",
        "_inverse_speed",
        "_rate",
        "a",
        "acceleration",
        "asked",
        "asked_a",
        "asked_jaw_end",
        "asked_point",
        "asked_q",
        "asked_v",
        "envelope",
        "index",
        "jaw_end",
        "point",
        "point_speed",
        "q",
        "recent",
        "sent",
        "speed",
        "v",
    )

    def __init__(self, index: int, envelope: ArmEnvelope, period: float) -> None:
        self.index, self.envelope = index, envelope
        self._rate = 1.0 / period
        self._inverse_speed = [(1.0 - ROUNDING) / x for x in envelope.max_speed]
        self._inverse_acceleration = [(1.0 - ROUNDING) / x for x in envelope.max_acceleration]
        latency = 2.0 * max(period, envelope.feedback_period)
        self.recent: deque[JointSetpoint] = deque(maxlen=1 + ceil(latency / period))
        self.begin(NO_SETPOINT)

    def begin(self, setpoint: JointSetpoint) -> None:
        """Starts a record at rest, at what the driver holds."""
        self.q = self.asked_q = (*setpoint.jp, setpoint.jaw)
        self.v: list[float] = list(NO_JOINTS)
        self.a: list[float] = list(NO_JOINTS)
        self.point, self.jaw_end = self.envelope.chain.points(self.q)
        self.sent = setpoint
        self.recent.clear()
        self.recent.append(setpoint)
        self.ask(setpoint)

    def ask(self, setpoint: JointSetpoint) -> None:
        """Works out once what the rules need to know about a sound setpoint."""
        rate = self._rate
        self.asked = setpoint
        q = self.asked_q = (*setpoint.jp, setpoint.jaw)
        v = self.asked_v = [(new - old) * rate for new, old in zip(q, self.q, strict=True)]
        a = self.asked_a = [(new - old) * rate for new, old in zip(v, self.v, strict=True)]
        self.speed: list[float] = list(map(mul, map(abs, v), self._inverse_speed))
        self.acceleration: list[float] = list(map(mul, map(abs, a), self._inverse_acceleration))
        point, self.asked_jaw_end = self.envelope.chain.points(q)
        x, y, z = self.point
        u, v_, w = point
        self.asked_point = point
        self.point_speed = rate * sqrt((u - x) ** 2 + (v_ - y) ** 2 + (w - z) ** 2)

    def accept(self) -> None:
        """What was asked has gone out."""
        self.sent = self.asked
        self.q, self.v, self.a = self.asked_q, self.asked_v, self.asked_a
        self.point, self.jaw_end = self.asked_point, self.asked_jaw_end
        self.recent.append(self.asked)

    def motions(self) -> list[Motion]:
        """Position, speed and acceleration at the last setpoint sent, joint by joint.

        A difference is the speed half a period ago; constant acceleration carries it to now.
        """
        half = 0.5 / self._rate
        return [(q, v + a * half, a) for q, v, a in zip(self.q, self.v, self.a, strict=True)]

    def stop(self) -> ArmStop:
        """The gate's own stop from the last setpoint sent."""
        envelope = self.envelope
        return ArmStop(self.motions(), envelope.max_acceleration, envelope.max_jerk)
