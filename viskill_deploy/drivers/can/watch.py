"""The watchdog of arms on CAN is in their drives: each stops by itself when it does not hear us.

Deadlines are written to every drive at start-up and read back, so a drive that answers is one that
watches. While arms move, only the runtime's own cycle sends SYNC and targets: when it hangs or
dies, the drives hear nothing and ramp down.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from viskill_deploy.core.types import Inputs
from viskill_deploy.drivers.can.axis import Axis


class DriveWatch:
    """The drives as a watchdog.

    Args:
        axes: all drives; () before the connection.

    Attributes:
        is_moving: the runtime beats: nobody may send in its place.
    """

    def __init__(self, axes: Callable[[], Sequence[Axis]]) -> None:
        self._axes, self.is_moving = axes, False

    def beat(self, now: float) -> None:
        """A cycle is done."""
        del now
        self.is_moving = True

    def release(self) -> None:
        """The arms are at rest: from now on the driver keeps the drives company by itself."""
        self.is_moving = False

    def told(self, inputs: Inputs, now: float) -> Inputs:
        """`inputs` with when the drive that was heard longest ago answered."""
        del now
        axes = self._axes()
        return replace(
            inputs,
            watchdog_stamp_s=min([axis.stamp_s for axis in axes]),
            watchdog_stepped_in=any(axis.has_lost_us for axis in axes),
        )

    def close(self) -> None:
        """Nothing to end: the drives watch as long as they have power."""
        self.is_moving = False
