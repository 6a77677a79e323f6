"""Stops at which the operator goes on: before every skill, or before every waypoint."""

from __future__ import annotations

from viskill_deploy.runtime.boundaries import Job, Stops
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.operator import asked
from viskill_deploy.runtime.session import Session


def may_go_on(session: Session, job: Job, place: Stops, what: str, result: EpisodeResult) -> bool:
    """Whether the run goes on; where the operator is asked, the arms rest and the gate looks on.

    Args:
        session: the arms, at rest.
        job: says where the operator is asked.
        place: where the arms are: before a skill, or before a waypoint.
        what: what comes next, in words.
        result: told why the run does not go on.

    Returns:
        False when the gate stepped in or the end was asked for; the arms are under its stop then.
    """
    is_asked = place == job.stops or (place == "skill" and job.stops == "waypoint")
    if not is_asked or job.operator is None:
        return True
    wish = asked(session, job.operator, f"next: {what} [Enter: go on, n: end]")
    if wish is not None and not wish.strip():
        return True
    if wish is not None:
        session.ask_to_stop()
    session.come_to_rest(result)
    return False
