"""A bundle on a robot: looked at, agreed to, approached, run, retreated from, switched off.

The same for every driver. Nothing is switched on before a person has said so. Homing, which is the
robot's own, may move an arm then; nothing else moves without the consent that the robot's own input
brings, and every motion is judged as a whole before it begins.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from viskill_deploy.core import realtime
from viskill_deploy.core.clock import MonotonicClock
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import (
    KinematicsError,
    MotionError,
    SafetyStop,
    ViskillError,
)
from viskill_deploy.core.types import CellState, Scene
from viskill_deploy.drivers.base import Driver
from viskill_deploy.runtime.air import lifted
from viskill_deploy.runtime.boundaries import Job, Stops
from viskill_deploy.runtime.checklist import Checklist, Found
from viskill_deploy.runtime.consent import PersonsConsent
from viskill_deploy.runtime.dry_run import LAYOUTS
from viskill_deploy.runtime.episodes import Mode, from_start_pose
from viskill_deploy.runtime.figures import Outcome, on_the_way, run_figures
from viskill_deploy.runtime.interrupting import go_on, interruptible
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.operator import Operator
from viskill_deploy.runtime.poses import Things
from viskill_deploy.runtime.preflight import Prepared
from viskill_deploy.runtime.readiness import look_at_robot
from viskill_deploy.runtime.record import Recorder
from viskill_deploy.runtime.rehearsing import Rehearsed, at_start, look_at_run
from viskill_deploy.runtime.session import Session
from viskill_deploy.runtime.unsent import UnsentDriver

FIRST_SPEED = 0.25
"""On arms, a policy begins with a quarter of every speed."""


@dataclass(frozen=True)
class ExecuteOptions:
    """How a bundle is executed.

    Attributes:
        mode: plan first and stream, or ask the policy at every step.
        speed: part of every speed, and of every limit of speed, in (0, 1].
        seed: of the scripted plan's random part.
        retries: how often a skill is tried again where a grasp was lost or the value is low.
        is_rehearsal: everything but the sending.
        lift_m: the whole plan is run so high above the board, with nothing to hold; 0 on it.
        stops: where the arms rest until the operator goes on.
        has_pedal: consent comes from an input of its own, whatever the arms are.
    """

    mode: Mode = "plan"
    speed: float = FIRST_SPEED
    ik_solver: str = "daqp"
    seed: int = 0
    retries: int = 1
    is_rehearsal: bool = False
    lift_m: float = 0.0
    stops: Stops = "nowhere"
    has_pedal: bool = False

    @property
    def has_things(self) -> bool:
        """Whether there is something to hold."""
        return not (self.is_rehearsal or self.lift_m)

    @property
    def stage(self) -> str:
        """In words, for people."""
        words = ["rehearsal, nothing is sent" if self.is_rehearsal else "on the arms"]
        words += [f"in the air, {1e3 * self.lift_m:g} mm above the board"] if self.lift_m else []
        words += [f"asking at every {self.stops}"] if self.stops != "nowhere" else []
        return ", ".join(words)


def look_before(
    prepared: Prepared, options: ExecuteOptions, driver: Driver, things: Things | None = None
) -> Checklist:
    """The preflight of a run: files, robot, scene and whole plan. Nothing is sent.

    Args:
        prepared: the files of the run.
        options: how it will be run.
        driver: connected.
        things: who knows where the things are; None for the driver.
    """
    checklist = Checklist(list(prepared.lines))
    state = look_at_robot(checklist, driver, prepared.cell)
    scene = checklist.look("things", "", partial(_seen, driver, things))
    if state is None or scene is None:
        return checklist
    start = checklist.look("start pose", "", partial(_start, prepared.cell, state))
    if start is not None:
        how = Rehearsed(
            driver.period_s,
            options.speed,
            options.ik_solver,
            options.seed,
            options.lift_m,
            options.stops,
        )
        look_at_run(checklist, prepared, start, scene, how)
    return checklist


def _seen(driver: Driver, things: Things | None) -> Found[Scene]:
    scene = things.scene(driver.clock.now()) if things is not None else driver.scene()
    if scene is None:
        raise MotionError("nothing says where the things are; name a scene file with --scene")
    return Found(scene, ", ".join(thing.name for thing in scene.objects))


def _start(cell: CellDescription, state: CellState) -> Found[CellState]:
    return Found(at_start(cell, state), "within reach; the arms go there first")


def execute(
    prepared: Prepared,
    options: ExecuteOptions,
    driver: Driver,
    recorder: Recorder,
    operator: Operator,
    things: Things | None = None,
) -> Outcome:
    """Runs a bundle once; to be called after a person has agreed to what `look_before` says.

    Args:
        prepared: the files of the run.
        options: how it is run.
        driver: connected; closed at the end, with the arms at rest and without power.
        recorder: where it is recorded.
        operator: at the terminal.
        things: who knows where the things are; None for the driver.
    """
    cell = lifted(prepared.cell, options.lift_m) if options.lift_m else prepared.cell
    clock, notes = MonotonicClock(), list(prepared.notes)
    if options.is_rehearsal:
        unsent = UnsentDriver(driver, cell)
        notes += [f"{name} is not homed: taken to be in its start pose" for name in unsent.assumed]
        driver = unsent
    line = Line(cell, driver.period_s, options.ik_solver, options.speed)
    training = prepared.bundle.manifest.training_range.seen
    consent = PersonsConsent(driver, operator.tell, options.has_pedal)
    session = Session(cell, driver, line, recorder, training, consent, things)
    failure: ViskillError | None = None
    began = clock.now()
    with session, interruptible(session):
        notes += [] if driver.capabilities.stepped else realtime.refusals()
        for note in notes:
            operator.tell(note)
        try:
            _run(session, prepared, options, operator)
            go_on(session)
        except ViskillError as error:
            failure = error
        way = on_the_way(driver)
    notes += things.notes if things is not None else []
    how = _how(prepared, options, driver)
    wall_s = clock.now() - began
    return Outcome(run_figures(prepared, session, how, wall_s, notes, way), failure)


def _run(session: Session, prepared: Prepared, options: ExecuteOptions, operator: Operator) -> None:
    """Switches on, approaches, runs and retreats; what came of it is in the ledger."""
    began, result = session.driver.clock.now(), EpisodeResult(0)
    try:
        rng, job = np.random.default_rng([LAYOUTS, options.seed]), _job(prepared, options, operator)
        result = from_start_pose(session, options.mode, job, rng, 0, operator)
    except (MotionError, KinematicsError, SafetyStop) as error:  # where nothing was to move yet
        session.settle()
        result.refused = str(error)
    finally:
        result.simulated_s = session.driver.clock.now() - began
        session.ledger.end_episode(result)


def _job(prepared: Prepared, options: ExecuteOptions, operator: Operator) -> Job:
    return Job(
        prepared.bundle,
        prepared.task,
        options.retries,
        ground=prepared.cell if options.lift_m else None,
        has_things=options.has_things,
        stops=options.stops,
        operator=operator,
        retreats=True,
    )


def _how(prepared: Prepared, options: ExecuteOptions, driver: Driver) -> dict[str, Any]:
    """The options that people compare runs by."""
    return {
        "mode": options.mode,
        "distribution": prepared.scene.path.name if prepared.scene else "as seen",
        "seed": options.seed,
        "ik_solver": options.ik_solver,
        "rate_hz": round(1.0 / driver.period_s, 6),
        "real_time": not driver.capabilities.stepped,
        "simulated": driver.capabilities.simulated,
        "judged": driver.capabilities.simulated and options.has_things,
        "speed": options.speed,
        "stage": options.stage,
        "lift_m": options.lift_m,
    }
