"""The main job: a bundle on the loopback, episode after episode, through the whole line."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from viskill_deploy.core import realtime
from viskill_deploy.core.clock import MonotonicClock
from viskill_deploy.core.errors import (
    KinematicsError,
    MotionError,
    SafetyStop,
    ViskillError,
)
from viskill_deploy.core.types import ObservationRange, Scene
from viskill_deploy.runtime.boundaries import Job
from viskill_deploy.runtime.consent import NodesConsent
from viskill_deploy.runtime.driving import DriverName, simulated_driver, with_inputs
from viskill_deploy.runtime.episodes import Mode, from_start_pose
from viskill_deploy.runtime.fault_injection import FaultInjector
from viskill_deploy.runtime.faults import Injection
from viskill_deploy.runtime.figures import Outcome, on_the_way, run_figures
from viskill_deploy.runtime.interrupting import go_on, interruptible
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.preflight import Prepared
from viskill_deploy.runtime.record import Recorder
from viskill_deploy.runtime.replay import PreparedTrajectory, followed
from viskill_deploy.runtime.session import Session
from viskill_deploy.sim.world import WorldOptions

LAYOUTS = 2**29
"""First number of the seeds of layouts: training never uses it."""


@dataclass(frozen=True)
class DryRunOptions:
    """What to run.

    Attributes:
        distribution: layouts are drawn from it, one an episode; None for the task's first.
        world: control period, noise and delay of the simulated cell.
        real_time: the simulated cell runs as a process of its own, against the clock.
        driver: what stands between runtime and simulated cell.
        inputs: the node whose consent counts, such as "can:pedal"; "" for the simulated operator.
        transport: what carries CRTK to a simulated cell in a process of its own.
        speed: how fast the time base of line and gate runs, in (0, 1].
        faults: what goes wrong on the way.
        retries: how often in an episode a skill is tried again where a grasp was lost or the value
            is low; 0 goes to the start pose at once.
    """

    episodes: int = 1
    seed: int = 0
    distribution: str | None = None
    mode: Mode = "closed-loop"
    world: WorldOptions = field(default_factory=WorldOptions)
    real_time: bool = False
    driver: DriverName = "loopback"
    inputs: str = ""
    transport: str = "dds"
    ik_solver: str = "daqp"
    speed: float = 1.0
    faults: tuple[Injection, ...] = ()
    retries: int = 1


def dry_run(
    prepared: Prepared | PreparedTrajectory,
    options: DryRunOptions,
    recorder: Recorder,
    progress: Callable[[EpisodeResult], None] = lambda result: None,
    say: Callable[[str], None] = lambda note: None,
) -> Outcome:
    """Runs a prepared bundle, or a trajectory, on the loopback.

    Args:
        prepared: bundle, task and cell; or waypoints and cell.
        options: what to run.
        recorder: where it is recorded.
        progress: called after every episode. A plan file that is refused ends the run.
        say: told what people should know before anything moves.
    """
    clock, notes = MonotonicClock(), list(prepared.notes)
    failure: ViskillError | None = None
    driver = simulated_driver(
        options.driver,
        prepared.cell,
        options.world,
        options.seed,
        options.real_time,
        options.transport,
    )
    driver = with_inputs(driver, options.inputs)
    consent = NodesConsent(say) if options.inputs else None
    faults: FaultInjector | None = None
    line = Line(prepared.cell, driver.period_s, options.ik_solver, options.speed)
    training: ObservationRange | None = None
    if isinstance(prepared, Prepared):
        training = prepared.bundle.manifest.training_range.seen
    if options.faults:
        faults = FaultInjector(options.faults, driver, recorder)
        driver, recorder = faults.driver, faults.recorder
        line = faults.line(prepared.cell, options.ik_solver, options.speed)
    session = Session(prepared.cell, driver, line, recorder, training, consent)
    with session, interruptible(session):
        if faults is not None:
            session.thinking_s = faults.thinking_s
        if options.real_time:
            notes += realtime.refusals()
        for note in notes:
            say(note)
        began = clock.now()
        try:
            for episode in range(options.episodes):
                result, refusal = _episode(session, prepared, options, episode)
                progress(result)
                if refusal is not None and isinstance(prepared, PreparedTrajectory):
                    raise refusal  # the same plan is refused in every episode
                go_on(session)
        except ViskillError as error:
            failure = error
        wall, way = clock.now() - began, on_the_way(driver)
    figures = run_figures(prepared, session, _how(prepared, options), wall, notes, way)
    figures["faults"] = [struck.facts() for struck in faults.struck] if faults else []
    return Outcome(figures, failure)


def _episode(
    session: Session,
    prepared: Prepared | PreparedTrajectory,
    options: DryRunOptions,
    episode: int,
) -> tuple[EpisodeResult, ViskillError | None]:
    """An episode's result, and why nothing was moved; None where something was."""
    refusal: ViskillError | None = None
    rng = np.random.default_rng([LAYOUTS, options.seed, episode])
    session.driver.reset(layout_of(prepared, options, rng))
    began = session.driver.clock.now()
    try:
        if isinstance(prepared, PreparedTrajectory):
            result = followed(session, prepared.waypoints, episode)
        else:
            job = Job(prepared.bundle, prepared.task, options.retries)
            result = from_start_pose(session, options.mode, job, rng, episode)
    except (MotionError, KinematicsError, SafetyStop) as error:  # before anything moved
        session.settle()
        result, refusal = EpisodeResult(episode, refused=str(error)), error
    result.simulated_s = session.driver.clock.now() - began
    session.ledger.end_episode(result)
    return result, refusal


def layout_of(
    prepared: Prepared | PreparedTrajectory,
    options: DryRunOptions,
    rng: np.random.Generator,
) -> Scene:
    """Where the things of an episode are put; those that it does not name stay where they are."""
    if isinstance(prepared, Prepared) and prepared.scene is not None:
        return prepared.scene.scene
    distribution = options.distribution or next(iter(prepared.distributions), None)
    if prepared.task is None or distribution is None:
        return Scene(0.0, (), "", np.zeros(3))
    return prepared.task.sample_layout(rng, distribution)


def _how(prepared: Prepared | PreparedTrajectory, options: DryRunOptions) -> dict[str, Any]:
    """The options that people compare runs by."""
    is_plan = isinstance(prepared, PreparedTrajectory)
    return {
        "mode": "trajectory" if is_plan else options.mode,
        "distribution": _where(prepared, options),
        "seed": options.seed,
        "ik_solver": options.ik_solver,
        "rate_hz": round(1.0 / options.world.period_s, 6),
        "real_time": options.real_time,
        "driver": options.driver,
        "speed": options.speed,
    }


def _where(prepared: Prepared | PreparedTrajectory, options: DryRunOptions) -> str:
    """Where the layouts come from, for the figures."""
    if isinstance(prepared, Prepared) and prepared.scene is not None:
        return prepared.scene.path.name
    return options.distribution or next(iter(prepared.distributions), "none")
