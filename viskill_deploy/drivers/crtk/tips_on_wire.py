"""A tracker beside the arms, on topics of this simulator's own: where it sees their tips."""

from __future__ import annotations

from viskill_deploy.drivers.crtk.messages import Header, Point, Pose, PoseStamped, Quaternion, Time
from viskill_deploy.drivers.crtk.scene_on_wire import PEERS_S
from viskill_deploy.drivers.crtk.transport import Transport
from viskill_deploy.sim.tracker import SimulatedTracker


def tip_topic(arm: str) -> str:
    """Topic, PoseStamped in the task frame, of an arm's tip; its orientation means nothing."""
    return f"/tracker/{arm}/measured_cp"


class TipsOnWire:
    """Publishes what a tracker sees, at the rate of things.

    Args:
        tracker: sees the tips.
        arms: names of the arms.
        transport: where it is published.
        rate_hz: how often.
    """

    def __init__(
        self, tracker: SimulatedTracker, arms: list[str], transport: Transport, rate_hz: float
    ) -> None:
        self._tracker, self._transport, self._period_s = tracker, transport, 1.0 / rate_hz
        self._publish = {arm: transport.publisher(tip_topic(arm), PoseStamped) for arm in arms}
        self._is_listened = False
        self._due_s = self._peers_due_s = 0.0

    def speak(self, now: float) -> None:
        """Looks, and publishes what is due at `now`, while somebody listens."""
        if now >= self._peers_due_s:
            self._peers_due_s = now + PEERS_S
            self._is_listened = any(self._transport.peers(tip_topic(a)) for a in self._publish)
        if not self._is_listened:
            return
        self._tracker.look(now)
        if now < self._due_s:
            return
        self._due_s = max(self._due_s + self._period_s, now)
        header = Header(Time.of_ns(self._transport.stamp_ns()), "task")
        for arm, (_, point) in self._tracker.points(now).items():
            pose = Pose(Point(*point.tolist()), Quaternion(0.0, 0.0, 0.0, 1.0))
            self._publish[arm](PoseStamped(header, pose))
