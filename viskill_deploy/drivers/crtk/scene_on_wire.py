"""Where the things on the board are, on topics of this simulator's own: a dVRK sees no things."""

from __future__ import annotations

from viskill_deploy.drivers.crtk.arm_cartesian import pose_of
from viskill_deploy.drivers.crtk.messages import NANO, Header, PoseStamped, Time
from viskill_deploy.drivers.crtk.transport import Transport
from viskill_deploy.drivers.loopback_cell import LoopbackCell

PEERS_S = 0.1
"""Between two looks at who listens."""


def scene_topic(thing: str) -> str:
    """Topic, PoseStamped in the task frame, of a thing of the cell, such as "block0"."""
    return f"/scene/{thing}/measured_cp"


class SceneOnWire:
    """Publishes the pose of every thing.

    Args:
        cell: where they are.
        transport: where it is published.
        rate_hz: how often.
    """

    def __init__(self, cell: LoopbackCell, transport: Transport, rate_hz: float) -> None:
        self._cell, self._transport, self._period_s = cell, transport, 1.0 / rate_hz
        self._publish = {
            thing: transport.publisher(scene_topic(thing), PoseStamped)
            for thing in cell.world.things
        }
        self._listened: set[str] = set()
        self._due_s = self._peers_due_s = 0.0

    def speak(self, now: float) -> None:
        """Publishes what is due at `now`, to those who listen."""
        if now >= self._peers_due_s:
            self._peers_due_s = now + PEERS_S
            self._listened = {t for t in self._publish if self._transport.peers(scene_topic(t))}
        if now < self._due_s or not self._listened:
            return
        self._due_s = max(self._due_s + self._period_s, now)
        scene = self._cell.scene(now)
        stamp_ns = self._transport.stamp_ns() - round((now - scene.stamp_s) * NANO)
        header = Header(Time.of_ns(stamp_ns), "task")
        for thing in scene.objects:
            if thing.name in self._listened:
                self._publish[thing.name](PoseStamped(header, pose_of(thing.T_task_object)))
