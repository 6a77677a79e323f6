"""What an arm publishes all the time, as its client knows it: the newest sample, and how old it is.

The robot's computer has a clock of its own. By how much it differs from ours is unknown, so a
sample counts as late by what it took longer than the quickest one did.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from viskill_deploy.core.types import Joints
from viskill_deploy.drivers.crtk.messages import NANO, JointState

BACK_NS: Final = NANO // 10
"""A stamp that is older than the last one by more says that the sender's clock was set."""

DRIFT: Final = 1e-3
"""How fast two clocks may drift apart, s/s: twice what NTP slews at most. A sender that is slower
than ours must not seem to fall behind for ever."""


class SenderClock:
    """Times of one sender's stamps on our clock.

    Attributes:
        restarts: how often its clock was set back.
    """

    def __init__(self) -> None:
        self._first_ns = self._last_ns = 0
        self._offset_s, self._received_s = math.inf, 0.0
        self.restarts = 0

    def time_of(self, stamp_ns: int, received_s: float) -> float | None:
        """When a sample was taken, on our clock; None for one that is not newer than the last.

        Args:
            stamp_ns: what its sender says; never zero.
            received_s: our clock when it came.
        """
        step_ns = stamp_ns - self._last_ns
        if self._last_ns and -BACK_NS <= step_ns <= 0:
            return None
        if not self._last_ns or step_ns < 0:
            self.restarts += bool(self._last_ns)
            self._first_ns, self._offset_s = stamp_ns, math.inf
        sent_s = (stamp_ns - self._first_ns) / NANO
        drift = DRIFT * (received_s - self._received_s)
        self._offset_s = min(received_s - sent_s, self._offset_s + drift)
        self._last_ns, self._received_s = stamp_ns, received_s
        return sent_s + self._offset_s


@dataclass(frozen=True, slots=True)
class Sample:
    """Joints of one moment.

    Attributes:
        stamp_s: driver's clock when they were so; 0.0 before any valid one.
        position, velocity: rad or m, and per s.
        is_valid: stamped, finite, and of the right joints.
        misfit: what does not fit the cell, in words; "" when all does.
    """

    stamp_s: float
    position: Joints
    velocity: Joints
    is_valid: bool = False
    misfit: str = ""


class JointStream:
    """One periodic topic of joints.

    Args:
        topic: its name, for messages.
        names: of the joints that it has to carry, in order.
        has_velocity: a sample without velocities is none.

    Attributes:
        newest: the last sample that counts. One that is older, or repeated, does not.
        clock: times of its stamps.
        is_heard: anything has come at all.
    """

    def __init__(self, topic: str, names: Sequence[str], has_velocity: bool) -> None:
        self.topic, self._names, self._has_velocity = topic, tuple(names), has_velocity
        self._rest = (0.0,) * len(self._names)
        self.clock, self.is_heard = SenderClock(), False
        self.newest = Sample(0.0, self._rest, self._rest)

    def hear(self, message: JointState, received_s: float) -> None:
        """Takes a message in; called by the transport."""
        self.is_heard = True
        misfit, stamp_ns = self._misfit(message), message.header.stamp.ns
        if misfit or stamp_ns == 0:  # dVRK 2.4 stamps with zero what it does not know
            self.newest = replace(self.newest, is_valid=False, misfit=misfit)
            return
        stamp_s = self.clock.time_of(stamp_ns, received_s)
        if stamp_s is None:
            return
        position, velocity = _floats(message.position), _floats(message.velocity) or self._rest
        is_finite = all(map(math.isfinite, (*position, *velocity)))
        self.newest = Sample(stamp_s, position, velocity, is_finite)

    def _misfit(self, message: JointState) -> str:
        count = len(self._names)
        if tuple(message.name) != self._names:
            names, wanted = ", ".join(message.name) or "no names", ", ".join(self._names)
            return f"{self.topic} carries the joints {names} and not {wanted}; correct the cell"
        speeds = len(message.velocity)
        allowed = {count} if self._has_velocity else {0, count}
        if len(message.position) != count or speeds not in allowed:
            return (
                f"{self.topic} carries {len(message.position)} positions and {speeds} velocities "
                f"for {count} joints; look at who publishes it"
            )
        return ""


def _floats(values: Sequence[Any]) -> Joints:
    return tuple(map(float, values))
