"""The figures of a run, ready for JSON: the same for a dry run and for one on the robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from viskill_deploy.core.errors import ViskillError
from viskill_deploy.runtime.preflight import Prepared
from viskill_deploy.runtime.replay import PreparedTrajectory
from viskill_deploy.runtime.session import Session


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    Attributes:
        figures: what it came to, ready for JSON.
        failure: what ended it early; None when all episodes were run.
    """

    figures: dict[str, Any]
    failure: ViskillError | None


def run_figures(
    prepared: Prepared | PreparedTrajectory,
    session: Session,
    how: Mapping[str, Any],
    wall_s: float,
    notes: Sequence[str],
) -> dict[str, Any]:
    """What a run came to.

    Args:
        prepared: what was run.
        session: in which it was run.
        how: the options that people compare runs by.
        wall_s: time that it took.
        notes: what people should know.
    """
    summary = session.ledger.summary()
    return {
        **prepared.about(),
        **how,
        **summary,
        "empty_jaw_rad": list(session.empty_jaw_rad),
        "wall_s": wall_s,
        "realtime_factor": summary["simulated_s"] / wall_s,
        "overruns": session.overruns,
        "files": [{"path": path, "sha256": digest} for path, digest in prepared.files],
        "notes": list(notes),
    }
