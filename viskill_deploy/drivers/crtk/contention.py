"""Whether a setpoint that an arm holds is one of ours, or another program commands the arm too."""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from viskill_deploy.core.types import Joints, JointSetpoint

UNDERWAY_S: Final = 0.1
"""How long a setpoint of ours may be on its way and still be what an arm holds."""

KEPT_S: Final = 1.0
"""An arm that was silent for longer than half of it is lost anyway."""

TOLERANCE: Joints = (0.005, 0.005, 0.0005, 0.005, 0.005, 0.005, 0.02)
"""rad, m; the jaw is the last one. As the gate's own rule on it (S24)."""


class Sent:
    """What one arm was sent lately.

    Arms are told where to be at a few hundred hertz and say where they are told to be at a hundred:
    what they say lies between two that were sent a short time before.

    Attributes:
        count: how many were ever sent.
    """

    def __init__(self) -> None:
        self.count = 0
        self._rows: deque[tuple[float, Joints]] = deque()

    @property
    def last_s(self) -> float:
        """When the last one went out; -inf when none did."""
        return self._rows[-1][0] if self._rows else -math.inf

    def forget(self) -> None:
        """The stream has ended."""
        self._rows.clear()

    def note(self, setpoint: JointSetpoint, now: float, held: Joints) -> None:
        """Remembers what goes out, and before the first of a stream what was held until then."""
        if not self._rows:
            self._rows.append((now - UNDERWAY_S, held))
        self.count += 1
        self._rows.append((now, (*setpoint.jp, setpoint.jaw)))
        while len(self._rows) > 2 and self._rows[1][0] < now - KEPT_S:
            self._rows.popleft()

    def stranger(self, held: Joints, stamp_s: float) -> int | None:
        """The first joint of which an arm holds a setpoint that is not ours; 6 is the jaw.

        Args:
            held: what it says that it holds, (7,).
            stamp_s: when it was so.
        """
        rows = self._since(stamp_s - UNDERWAY_S)
        if not rows or held in rows:
            return None
        for joint, (low, high) in enumerate(zip(map(min, *rows), map(max, *rows), strict=True)):
            if not low - TOLERANCE[joint] <= held[joint] <= high + TOLERANCE[joint]:
                return joint
        return None

    def age_s(self, jp: Joints, stamp_s: float) -> float | None:
        """How old the setpoint is that an arm holds; None where that cannot be told.

        An arm that rests holds what it was sent many times.

        Args:
            jp: what it says that it holds, without the jaw.
            stamp_s: when it was so.
        """
        found_s = math.nan
        for sent_s, row in reversed(self._rows):
            is_same = row[:6] == jp
            if not math.isnan(found_s):
                return None if is_same else max(stamp_s - found_s, 0.0)
            found_s = sent_s if is_same else math.nan
        return None

    def _since(self, start_s: float) -> list[Joints]:
        """What was sent since then, newest first, and what was in force then; at least two."""
        rows: list[Joints] = []
        for sent_s, row in reversed(self._rows):
            rows.append(row)
            if sent_s <= start_s and len(rows) > 1:
                break
        return rows
