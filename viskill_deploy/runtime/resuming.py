"""After a HOLD: the operator is asked, what follows is planned anew, and the gate lets go."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from viskill_deploy.core.errors import ViskillError
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.operator import Operator, asked_while_held
from viskill_deploy.runtime.session import Session
from viskill_deploy.runtime.thinking import think_while_held

T = TypeVar("T")


def resumed(
    session: Session,
    operator: Operator | None,
    result: EpisodeResult,
    look: Callable[[], Callable[[], T]],
) -> T | None:
    """What follows, once the operator wants it and the gate lets go; the arms rest until then.

    The gate goes on holding the arms until it has seen nothing wrong for a while.

    Args:
        session: the arms, under the gate's stop.
        operator: who may resume; None for nobody.
        result: says what they are held for; told how it went on.
        look: sees where the arms are held, and returns what makes what follows from there.

    Returns:
        None where it was more than a HOLD, where a person has ended the run, or where nothing can
        follow; `result` says why then.
    """
    if operator is None or session.is_stop_wanted:
        return None
    session.attend()
    while session.is_held:
        question = f"held ({result.stopped_by}: {result.reason or 'by the gate'}); resume?"
        wish = asked_while_held(session, operator, f"{question} [Enter: yes, n: no]")
        if wish is None or wish.strip():
            break
        try:
            follows = think_while_held(session, look())
        except (ViskillError, ValueError) as error:
            result.reason = f"not resumed: {error}"
            break
        against = session.resume()
        if not against:
            result.resumed.append(result.stopped_by)
            result.stopped_by = result.reason = ""
            return follows
        rules = ", ".join(dict.fromkeys(verdict.rule for verdict in against))
        operator.tell(f"the gate does not let go yet ({rules}); put that right")
    operator.tell("not resumed: the run ends here")
    return None
