"""Makes the control process as punctual as the system permits, and says what it did not permit."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import sys
from collections.abc import Iterator

PRIORITY = 50
WATCHDOG_PRIORITY = 60
"""Above what it watches: a control loop that never sleeps must not keep it from looking."""

EARS_PRIORITY = 55
"""Of threads that bring the control loop what it waits for, and are done at once."""

DRIVES_PRIORITY = 58
"""Of simulated drives: real ones have a processor of their own and wait for no control loop."""

ROBOT_PRIORITY = 45
"""Of a simulated robot, which takes half of a core: a real one has a computer of its own, and does
not stand in the control loop's way."""

SWITCH_S = 0.001
"""A thread gives Python's lock away whenever it sleeps, sends or waits, and waits this long to get
it back from one that computes, such as a policy that thinks. Python's own 5 ms are a whole cycle;
0.1 ms make threads that have much to do take it from each other all the time."""

PYTHONS_SWITCH_S = 0.005

_MCL_CURRENT, _MCL_FUTURE = 1, 2


_settled: list[str] | None = None
"""What `settle` was refused; None before it, and after `release`."""


def settle() -> list[str]:
    """Sweeps and freezes what there is, and locks memory: both stand the process still for a while.

    From then on threads hand Python's lock on quickly. Done once, before arms have power; again
    only after `release`.

    Returns:
        One sentence for each thing that was refused; empty when all was granted.
    """
    global _settled  # noqa: PLW0603 - a property of the process
    if _settled is None:
        sys.setswitchinterval(min(SWITCH_S, sys.getswitchinterval()))
        gc.collect()
        gc.freeze()
        _settled = []
        libc = ctypes.CDLL(None, use_errno=True)
        if not hasattr(libc, "mlockall") or libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
            _settled.append(
                "memory is not locked: a page fault may delay the control loop; "
                "allow it with a memlock entry in /etc/security/limits.conf"
            )
    return list(_settled)


def prepare(priority: int = PRIORITY, sweeps: bool = True) -> list[str]:
    """From now on the calling thread is punctual: SCHED_FIFO, no garbage collector; settled.

    Args:
        priority: real-time priority.
        sweeps: collects garbage first; not while a gate holds arms, which would see nobody.

    Returns:
        One sentence for each thing that was refused; empty when all was granted.
    """
    notes = settle()
    if sweeps:
        gc.collect()  # little: what there was when it settled is frozen
    gc.disable()
    return first_in_line(priority) + notes


def first_in_line(priority: int = PRIORITY) -> list[str]:
    """Asks for SCHED_FIFO for the calling thread; returns what was refused."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (AttributeError, OSError) as error:
        return [
            f"no real-time scheduling ({error}): other programs may delay the control loop; "
            "allow it with a rtprio entry in /etc/security/limits.conf"
        ]
    return []


def out_of_line() -> None:
    """The calling thread has time: normal scheduling, whatever it took after."""
    if hasattr(os, "sched_setscheduler"):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@contextlib.contextmanager
def ahead(priority: int = EARS_PRIORITY) -> Iterator[None]:
    """Threads that are started within are first in line from their start, where that is granted.

    A thread takes after the one that starts it; what a library starts cannot be reached otherwise.
    """
    if not hasattr(os, "sched_setscheduler"):
        yield
        return
    policy, param = os.sched_getscheduler(0), os.sched_getparam(0)
    first_in_line(priority)
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, param)


def pause() -> None:
    """Gives normal scheduling and garbage collection back; what is settled stays so."""
    gc.enable()
    out_of_line()


def release() -> None:
    """Gives pageable memory back, too."""
    global _settled  # noqa: PLW0603
    pause()
    sys.setswitchinterval(PYTHONS_SWITCH_S)
    gc.unfreeze()
    _settled = None
    libc = ctypes.CDLL(None)
    if hasattr(libc, "munlockall"):
        libc.munlockall()


def refusals() -> list[str]:
    """What `prepare` would be refused, without keeping anything."""
    notes = prepare()
    release()
    return notes
