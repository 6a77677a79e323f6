"""Arms that are in FAULT: a person looks at them, and says so, before they are used again."""

from __future__ import annotations

from typing import Final, Protocol

from viskill_deploy.core.errors import DriverError, Interrupted
from viskill_deploy.runtime.operator import Operator, typed

WORD: Final = "recover"
"""What a person types; nothing else counts, and no option stands in for it."""


class Recoverable(Protocol):
    """Arms that keep a fault until they are told that it is over.

    Attributes:
        fault: why a person has to look at them; "" when nobody has to.
    """

    @property
    def fault(self) -> str:  # noqa: D102 - above
        ...

    def recover(self) -> None:
        """Clears it: the arms are DISABLED. Raises DriverError when one stays in FAULT."""
        ...


def recover(arms: Recoverable | None, operator: Operator) -> None:
    """Clears a fault, once a person has typed that the arms were looked at. Nothing is enabled.

    Args:
        arms: None where a robot has nothing to be cleared in this way.
        operator: at the terminal.

    Raises:
        DriverError: the robot has no such way, or an arm stays in FAULT.
        Interrupted: the person has typed something else; nothing was sent.
    """
    if arms is None:
        raise DriverError("--recover is for arms over CRTK; leave it out")
    fault = arms.fault
    if not fault:
        operator.tell("no arm is in FAULT: there is nothing to clear")
        return
    operator.tell(fault)
    question = f'if you have looked at the arms and put the cause right, type "{WORD}"'
    if typed(operator, f"{question}; anything else leaves them as they are") != WORD:
        raise Interrupted("not cleared; the arms are as they were")
    arms.recover()
    operator.tell("cleared: the arms are DISABLED; go on as with arms that were just switched on")
