"""DDS domains that no other run of the tests on this machine has at the same time.

Each run, and each worker of one, holds the lock of a file for as long as it lives. Domains above
100 would need ports that the system gives to anyone.
"""

import fcntl
import tempfile
from pathlib import Path
from typing import IO

EACH = 8
"""Domains of one run, from `DOMAIN` on."""


def _take() -> tuple[int, IO[str]]:
    for first in range(4, 100 - EACH, EACH):
        lock = (Path(tempfile.gettempdir()) / f"viskill-test-domain-{first}").open("w")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.close()
            continue
        return first, lock
    raise RuntimeError("every DDS domain for tests is taken; end the other runs of the tests")


DOMAIN, _LOCK = _take()
