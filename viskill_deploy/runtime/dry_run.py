"""The main job: a bundle on the loopback, episode after episode, through the whole line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from viskill_deploy.core.clock import MonotonicClock
from viskill_deploy.core.errors import MotionError, SafetyStop
from viskill_deploy.drivers import loopback, loopback_served
from viskill_deploy.drivers.base import Driver
from viskill_deploy.runtime import realtime
from viskill_deploy.runtime.episodes import Job, closed_loop, planned
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.preflight import Prepared
from viskill_deploy.runtime.session import Recorder, Session
from viskill_deploy.sim.world import WorldOptions

Mode = Literal["closed-loop", "plan"]


@dataclass(frozen=True)
class DryRunOptions:
    """What to run.

    Attributes:
        rate_hz: control rate, 100 to 1000.
        real_time: the loopback runs as a process of its own, against the clock.
        speed: part of the planned tip speed to use, in (0, 1].
        noise: measurement noise and delay of the simulated cell.
    """

    episodes: int = 1
    seed: int = 0
    distribution: str = "reference"
    mode: Mode = "closed-loop"
    rate_hz: float = 250.0
    real_time: bool = False
    ik_solver: str = "daqp"
    speed: float = 1.0
    joint_noise_rad: float = 0.0
    joint_noise_m: float = 0.0
    object_noise_m: float = 0.0
    delay_periods: int = 0


def dry_run(
    prepared: Prepared,
    options: DryRunOptions,
    recorder: Recorder,
    progress: Callable[[EpisodeResult], None] = lambda result: None,
) -> dict[str, Any]:
    """Runs a prepared bundle on the loopback.

    Args:
        prepared: bundle, task and cell.
        options: what to run.
        recorder: where it is recorded.
        progress: called after every episode.

    Returns:
        The run's figures, ready for JSON.
    """
    notes, clock = list(prepared.notes), MonotonicClock()
    driver = _driver(prepared, options)
    line = Line(prepared.cell, driver.period_s, options.ik_solver, options.speed)
    with Session(prepared.cell, driver, line, recorder) as session:
        if options.real_time:
            notes += realtime.prepare()
        began = clock.now()
        try:
            for episode in range(options.episodes):
                progress(_episode(session, prepared, options, episode))
        finally:
            if options.real_time:
                realtime.release()
        wall = clock.now() - began
    return _figures(prepared, options, session, wall, notes)


def _driver(prepared: Prepared, options: DryRunOptions) -> Driver:
    if options.real_time:
        return loopback_served.connect(prepared.cell, 1.0 / options.rate_hz, options.seed)
    world = WorldOptions(
        period_s=1.0 / options.rate_hz,
        joint_noise_rad=options.joint_noise_rad,
        joint_noise_m=options.joint_noise_m,
        object_noise_m=options.object_noise_m,
        delay_periods=options.delay_periods,
    )
    return loopback.connect(prepared.cell, world, options.seed)


def _episode(
    session: Session, prepared: Prepared, options: DryRunOptions, episode: int
) -> EpisodeResult:
    rng = np.random.default_rng([options.seed, episode])
    session.driver.reset(prepared.task.sample_layout(rng, options.distribution))
    began = session.driver.clock.now()
    job = Job(prepared.bundle, prepared.task)
    try:
        if options.mode == "plan":
            result = planned(session, job, rng, episode, options.speed)
        else:
            result = closed_loop(session, job, rng, episode)
    except (MotionError, SafetyStop) as error:  # refused before anything moved
        result = EpisodeResult(episode, stopped_by=str(error))
    result.simulated_s = session.driver.clock.now() - began
    session.ledger.end_episode(result)
    return result


def _figures(
    prepared: Prepared,
    options: DryRunOptions,
    session: Session,
    wall_s: float,
    notes: list[str],
) -> dict[str, Any]:
    summary = session.ledger.summary()
    manifest = prepared.bundle.manifest
    return {
        "task": manifest.task,
        "bundle": manifest.name,
        "mode": options.mode,
        "distribution": options.distribution,
        "seed": options.seed,
        "ik_solver": options.ik_solver,
        "rate_hz": options.rate_hz,
        "real_time": options.real_time,
        **summary,
        "wall_s": wall_s,
        "realtime_factor": summary["simulated_s"] / wall_s,
        "overruns": session.overruns,
        "files": [{"path": path, "sha256": digest} for path, digest in prepared.files],
        "notes": notes,
    }
