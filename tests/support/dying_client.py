"""A client of a guard that swings one joint until it is killed; says "moving" once it does.

Its argument is the DDS domain.
"""

import sys
import threading
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

from guard_latency import Client

from viskill_deploy.core import realtime
from viskill_deploy.drivers.crtk.opening import LOOPBACK, Network, open_transport

if __name__ == "__main__":
    realtime.prepare()
    client = Client(open_transport("dds", Network(int(sys.argv[1]), LOOPBACK)))
    client.make_ready()
    threading.Timer(1.5, print, ("moving",), {"flush": True}).start()
    client.stream(600.0)
