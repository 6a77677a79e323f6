"""The recorder's own process: frames from standard input to a rosbag2 bag.

Started by `recording.Recorder`. When the runtime ends, however it ends, the pipe gives end of file
and the bag is closed properly. It needs numpy alone: no robot, no model, no ROS.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

from viskill_deploy.observe.bag import Bag
from viskill_deploy.observe.frames import HEADER, Kind

READ_BYTES = 1 << 20
CHUNK_BYTES = 1 << 20
CHUNK_S = 1.0
"""A chunk is written when this much waits or this long has passed: the most a crash here loses."""

NAP_S = 0.02
"""Pause between reads. Reading in gulps spares a one-core machine a switch in every cycle."""


class Intake:
    """Cuts the stream of bytes into frames and hands them to the bag."""

    def __init__(self, folder: Path) -> None:
        self.bag: Bag | None = None
        self._folder = folder
        self._rest = b""

    def feed(self, data: bytes) -> None:
        """Takes the next bytes of the stream; half a frame waits for its other half."""
        data, at = self._rest + data, 0
        while at + HEADER.size <= len(data):
            kind, size = HEADER.unpack_from(data, at)
            end = at + HEADER.size + size
            if end > len(data):
                break
            self._take(Kind(kind), data[at + HEADER.size : end])
            at = end
        self._rest = data[at:]

    def _take(self, kind: Kind, payload: bytes) -> None:
        if kind is Kind.HELLO:
            self.bag = Bag(self._folder, json.loads(payload))
        elif self.bag is not None:
            self.bag.take(kind, payload)


def serve(descriptor: int, folder: Path) -> None:
    """Records everything that comes until end of file, then closes the bag."""
    intake = Intake(folder)
    written_s = time.monotonic()
    while data := os.read(descriptor, READ_BYTES):
        intake.feed(data)
        bag = intake.bag
        due = time.monotonic() - written_s > CHUNK_S
        if bag is not None and (due or bag.waiting_bytes > CHUNK_BYTES):
            bag.write()
            written_s = time.monotonic()
        if len(data) < READ_BYTES // 4:
            time.sleep(NAP_S)
    if intake.bag is not None:
        intake.bag.finish()


def step_back() -> None:
    """Leaves the processor to the control loop: ordinary scheduling, a lower priority."""
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    os.nice(5)


if __name__ == "__main__":
    step_back()
    serve(sys.stdin.fileno(), Path(sys.argv[1]))
