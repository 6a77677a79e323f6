"""The figures of a run, ready for JSON: the same for a dry run and for one on the robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from viskill_deploy.core.errors import DriverError, ViskillError
from viskill_deploy.drivers.base import Driver
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


@runtime_checkable
class OnTheWay(Protocol):
    """A driver whose setpoints go over a network."""

    def on_the_way(self) -> dict[str, Any]:
        """How they fare on their way."""
        ...


def on_the_way(driver: Driver) -> dict[str, Any]:
    """How setpoints fared on their way, against the clock; {} where there is no way. Still open."""
    if driver.capabilities.stepped or not isinstance(driver, OnTheWay):
        return {}
    try:
        return driver.on_the_way()
    except DriverError:  # nobody is left to ask
        return {}


def run_figures(
    prepared: Prepared | PreparedTrajectory,
    session: Session,
    how: Mapping[str, Any],
    wall_s: float,
    notes: Sequence[str],
    way: Mapping[str, Any],
) -> dict[str, Any]:
    """What a run came to.

    Args:
        prepared: what was run.
        session: in which it was run.
        how: the options that people compare runs by.
        wall_s: time that it took.
        notes: what people should know.
        way: how setpoints fared on their way, see `on_the_way`.
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
        "on_the_way": dict(way),
        "files": [{"path": path, "sha256": digest} for path, digest in prepared.files],
        "notes": list(notes),
    }
