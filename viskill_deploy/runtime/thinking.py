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

from viskill_deploy.core import realtime
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
    answer = _asked(question, delay)
    while not answer.done():
        _cycle(session)
    return answer.result()


def think_while_held(session: Session, question: Callable[[], T]) -> T:
    """The answer to `question` while the gate goes on holding arms at rest, and looking at them.

    Args:
        session: at rest, under the gate's stop.
        question: touches nothing of the session but what never changes.

    Raises:
        SafetyStop: meanwhile it came to more than a HOLD, or a person has ended the run.
    """
    if session.driver.capabilities.stepped:
        return question()

    def out_of_the_way() -> T:
        realtime.out_of_line()  # it takes seconds, and the gate is to look on meanwhile
        return question()

    answer = _asked(out_of_the_way)
    while not answer.done():
        session.cycle()
        if session.is_stop_wanted or not session.is_held:
            raise SafetyStop("the run was ended before there was a plan")
    return answer.result()


def _asked(question: Callable[[], T], delay_s: float = 0.0) -> Future[T]:
    """The answer that a thread of its own will give."""
    answer: Future[T] = Future()

    def think() -> None:
        if delay_s:
            threading.Event().wait(None if delay_s == math.inf else delay_s)
        try:
            answer.set_result(question())
        except BaseException as error:  # noqa: BLE001 - handed on to the caller as it is
            answer.set_exception(error)

    # a daemon: a policy that hangs for ever must not keep the process
    threading.Thread(target=think, name="policy", daemon=True).start()
    return answer


def _go_on_for(session: Session, delay_s: float) -> None:
    """The control loop goes on for some simulated time; no cycle passes when it is 0."""
    clock = session.driver.clock
    ready_s = clock.now() + delay_s
    while clock.now() < ready_s - 1e-9:
        _cycle(session)


def _cycle(session: Session) -> None:
    if not session.cycle():
        raise SafetyStop("the gate stepped in while the policy was thinking")
