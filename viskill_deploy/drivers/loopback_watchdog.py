"""The watchdog of the served loopback, a process of its own. Started by `loopback_served`."""

from __future__ import annotations

import sys
from pathlib import Path

from viskill_deploy.core import realtime
from viskill_deploy.drivers import watch
from viskill_deploy.drivers.loopback_stop import StopHandle

if __name__ == "__main__":
    handle = StopHandle(Path(sys.argv[2]))
    realtime.prepare(realtime.WATCHDOG_PRIORITY)
    watch.main(handle, int(sys.argv[1]))
