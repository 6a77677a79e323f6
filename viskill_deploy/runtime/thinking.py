"""Deciding what comes next without leaving the arms alone.

In stepped time nothing moves while a decision is made, so it is simply made. Against the clock the
decision is made in a thread of its own, and the control loop goes on: a late one finds the arms
braking, and 100 ms after it was due the gate stops them (S19).
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

from viskill_deploy.core.errors import SafetyStop
from viskill_deploy.runtime.session import Session

T = TypeVar("T")


def decide(session: Session, question: Callable[[], T]) -> T:
    """The answer to `question`; the control loop goes on meanwhile where time does.

    Args:
        session: what goes on.
        question: touches nothing of the session, which another thread drives.

    Raises:
        SafetyStop: the gate stepped in before there was an answer.
    """
    delay = session.thinking_s()
    if session.driver.capabilities.stepped:
        _go_on_for(session, delay)
        return question()
    answer: Future[T] = Future()

    def think() -> None:
        if delay:
            threading.Event().wait(None if delay == math.inf else delay)
        try:
            answer.set_result(question())
        except BaseException as error:  # noqa: BLE001 - handed on to the caller as it is
            answer.set_exception(error)

    # a daemon: a policy that hangs for ever must not keep the process
    threading.Thread(target=think, name="policy", daemon=True).start()
    while not answer.done():
        _cycle(session)
    return answer.result()


def _go_on_for(session: Session, delay_s: float) -> None:
    """The control loop goes on for some simulated time; no cycle passes when it is 0."""
    clock = session.driver.clock
    ready_s = clock.now() + delay_s
    while clock.now() < ready_s - 1e-9:
        _cycle(session)


def _cycle(session: Session) -> None:
    if not session.cycle():
        raise SafetyStop("the gate stepped in while the policy was thinking")
