"""Poses of things from a tracker that publishes them on topics, PoseStamped in the task frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial

import numpy as np

from viskill_deploy.core.types import FloatArray
from viskill_deploy.drivers.crtk.messages import NANO, Pose, PoseStamped
from viskill_deploy.drivers.crtk.transport import Transport
from viskill_deploy.runtime.poses import Sighting

FRAMES = ("", "task")
"""What the header of a pose in the task frame may say of its frame."""

UNIT = 1e-3
"""How far the length of a quaternion may be from 1."""


class TopicPoses:
    """The newest pose of every thing; it is a `PoseSource`.

    A pose counts from when its stamp says that it was seen, as far as this machine's clock can
    tell: a tracker whose clock is behind seems late, and late poses hold the arms. A stamp that is
    not newer than the last, a pose in another frame and one that is none are not taken.

    Args:
        transport: a node; the one who opened it closes it.
        topics: topic of every thing, by name.
        sigma_m: how well each position is known, by name, m: a PoseStamped does not say.
    """

    def __init__(
        self, transport: Transport, topics: Mapping[str, str], sigma_m: Mapping[str, float]
    ) -> None:
        self._transport, self._sigma_m = transport, dict(sigma_m)
        self._newest: dict[str, Sighting] = {}
        self._stamps: dict[str, int] = {}
        for name, topic in topics.items():
            transport.subscribe(topic, PoseStamped, partial(self._hear, name))

    def newest(self, name: str) -> Sighting | None:
        """The newest pose; None when none was heard."""
        return self._newest.get(name)

    def close(self) -> None:
        """Whoever opened the node closes it."""

    def _hear(self, name: str, word: PoseStamped, received_s: float) -> None:
        stamp_ns = word.header.stamp.ns
        if word.header.frame_id not in FRAMES or stamp_ns <= self._stamps.get(name, 0):
            return
        T = matrix_of(word.pose)
        if T is not None:
            late_s = max(self._transport.stamp_ns() - stamp_ns, 0) / NANO
            self._stamps[name] = stamp_ns
            self._newest[name] = Sighting(T, received_s - late_s, self._sigma_m[name])


def matrix_of(pose: Pose) -> FloatArray | None:
    """A pose as (4, 4); None where it is none: not finite, or with a quaternion that is no turn."""
    p, q = pose.position, pose.orientation
    numbers = (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
    if not all(map(math.isfinite, numbers)):
        return None
    size = math.sqrt(q.x * q.x + q.y * q.y + q.z * q.z + q.w * q.w)
    if not abs(size - 1.0) <= UNIT:
        return None
    x, y, z, w = (value / size for value in (q.x, q.y, q.z, q.w))
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), p.x],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), p.y],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), p.z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
