"""Makes the control process as punctual as the system permits, and says what it did not permit."""

from __future__ import annotations

import ctypes
import gc
import os

PRIORITY = 50
WATCHDOG_PRIORITY = 60
"""Above what it watches: a control loop that never sleeps must not keep it from looking."""

_MCL_CURRENT, _MCL_FUTURE = 1, 2


def prepare(priority: int = PRIORITY) -> list[str]:
    """Freezes the garbage collector, asks for SCHED_FIFO and locked memory.

    Returns:
        One sentence for each thing that was refused; empty when all was granted.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    notes = []
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (AttributeError, OSError) as error:
        notes.append(
            f"no real-time scheduling ({error}): other programs may delay the control loop; "
            "allow it with a rtprio entry in /etc/security/limits.conf"
        )
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "mlockall") or libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
        notes.append(
            "memory is not locked: a page fault may delay the control loop; "
            "allow it with a memlock entry in /etc/security/limits.conf"
        )
    return notes


def release() -> None:
    """Gives normal scheduling, pageable memory and garbage collection back."""
    gc.enable()
    gc.unfreeze()
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    libc = ctypes.CDLL(None)
    if hasattr(libc, "munlockall"):
        libc.munlockall()


def refusals() -> list[str]:
    """What `prepare` would be refused, without keeping anything."""
    notes = prepare()
    release()
    return notes
