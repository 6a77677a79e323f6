"""The person who runs a policy: is told things, is asked things, and takes their time to answer.

An answer is a wish, never the consent to motion: that comes with the driver's inputs (S22).
"""

from __future__ import annotations

from typing import Final, Protocol

from viskill_deploy.core.clock import MonotonicClock
from viskill_deploy.runtime.session import Session

LOOK_S: Final = 0.02
"""How soon an answer is seen that nobody but a person waits for."""


class Operator(Protocol):
    """Somebody at a terminal."""

    def tell(self, note: str) -> None:
        """Shows them a line."""
        ...

    def ask(self, question: str) -> None:
        """Shows them a question; what was typed before it is no answer to it."""
        ...

    def answer(self) -> str | None:
        """What they have answered; None while they have not. Waits no longer than a moment.

        Raises:
            Interrupted: nobody can answer any more.
        """
        ...


def typed(operator: Operator, question: str) -> str:
    """The answer to a question, however long it takes; while no arm counts on us.

    Raises:
        Interrupted: nobody can answer any more.
    """
    operator.ask(question)
    clock = MonotonicClock()
    while (answer := operator.answer()) is None:
        clock.sleep_until(clock.now() + LOOK_S)
    return answer.strip()


def asked(session: Session, operator: Operator, question: str) -> str | None:
    """The answer to a question, while the control loop goes on; the arms rest.

    Returns:
        None when the gate stepped in, or when the end of the run was asked for.
    """
    operator.ask(question)
    while not session.is_stop_wanted:
        answer = operator.answer()
        if answer is not None:
            return answer
        if not session.cycle():
            return None
    return None


def asked_while_held(session: Session, operator: Operator, question: str) -> str | None:
    """The same under the gate's stop, which goes on holding the arms.

    Returns:
        None when the stop has become more than a HOLD, or when the end of the run was asked for.
    """
    operator.ask(question)
    while not session.is_stop_wanted and session.is_held:
        answer = operator.answer()
        if answer is not None:
            return answer
        session.cycle()
    return None
