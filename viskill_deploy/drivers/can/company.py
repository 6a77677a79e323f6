"""What keeps drives company while arms are at rest and the runtime thinks.

A drive that hears nobody stops by itself. While arms move, that is what it is for, and only the
runtime's own cycle sends; at rest this thread sends what the drives hold.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable

from viskill_deploy.core import realtime
from viskill_deploy.core.clock import Clock

SWITCH_S = 0.0001
"""A thread gives Python's lock away with every frame that it sends, and waits this long to get it
back from one that computes. Python's own 5 ms would make 80 of one cycle."""


class Company:
    """A thread that calls `keep` once in every period until it is closed.

    Args:
        keep: sends a cycle, if one is due and the arms are at rest.
        clock: the driver's.
        period_s: control period.
    """

    def __init__(self, keep: Callable[[], None], clock: Clock, period_s: float) -> None:
        self._keep, self._clock, self._period_s = keep, clock, period_s
        self._is_over = False
        self._switch_s = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_S)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends it."""
        self._is_over = True
        self._thread.join()
        sys.setswitchinterval(self._switch_s)

    def _run(self) -> None:
        realtime.first_in_line(realtime.EARS_PRIORITY)
        while not self._is_over:
            self._clock.sleep_until(self._clock.now() + self._period_s)
            self._keep()
