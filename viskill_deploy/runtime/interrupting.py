"""What ends a run from outside: a person, an emergency stop, a record that is not kept."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from typing import Protocol

from viskill_deploy.core.errors import Interrupted, SafetyStop
from viskill_deploy.core.types import Mode
from viskill_deploy.runtime.session import Session


class Stoppable(Protocol):
    """A run that a person may end."""

    is_stop_wanted: bool

    def ask_to_stop(self) -> None:
        """Acts at the end of the present cycle."""
        ...


@contextlib.contextmanager
def interruptible(session: Stoppable) -> Iterator[None]:
    """Ctrl-C and SIGTERM ask for a stop at the end of the cycle; a second one ends it at once."""

    def ask(signum: int, frame: object) -> None:
        if session.is_stop_wanted:
            raise KeyboardInterrupt
        session.ask_to_stop()

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def go_on(session: Session) -> None:
    """Raises what ends a run after an episode."""
    if session.is_stop_wanted:
        raise Interrupted("interrupted; the arms were brought to rest")
    if session.gate.mode is Mode.ESTOPPED:
        raise SafetyStop("emergency stop: start a new process when the cause is gone")
    if not session.recorder.alive:
        raise SafetyStop("the recorder failed; look at the disk, then start again")
