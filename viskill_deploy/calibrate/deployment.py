"""A policy on hidden robots, before and after their calibration: one trial after the other.

What the paper did on one dVRK, on many simulated ones. A trial is the same layout, seen with the
same errors, on the same robot in every condition.
"""

from __future__ import annotations

import datetime
import functools
import hashlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from viskill_deploy.bundle.format import MANIFEST
from viskill_deploy.calibrate import collect as collecting
from viskill_deploy.calibrate.apply import calibration_file
from viskill_deploy.calibrate.collect import collect
from viskill_deploy.calibrate.fit import fit_arm
from viskill_deploy.calibrate.measurements import load
from viskill_deploy.calibrate.programme import choose_poses
from viskill_deploy.calibrate.study import CALIBRATING, poses_for
from viskill_deploy.calibrate.trial_lines import add_line, read_lines
from viskill_deploy.calibrate.truths import HiddenRobot, hidden_robot, scaled
from viskill_deploy.core.arm_errors import with_errors
from viskill_deploy.core.calibration_files import calibrated, read_calibration, write_calibration
from viskill_deploy.core.clock import MonotonicClock
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import CalibrationError, KinematicsError, MotionError, SafetyStop
from viskill_deploy.core.types import Scene
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.runtime.boundaries import Job
from viskill_deploy.runtime.dry_run import LAYOUTS
from viskill_deploy.runtime.episodes import Mode, from_start_pose
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.planning import OFF_PLAN_M
from viskill_deploy.runtime.preflight import Prepared, prepare
from viskill_deploy.runtime.record import NoRecord
from viskill_deploy.runtime.session import Session
from viskill_deploy.sim.tasks.base import load_task
from viskill_deploy.sim.tracker import SimulatedTracker
from viskill_deploy.sim.world import WorldOptions

TRIALS = "trials.jsonl"
PERIOD_S = CALIBRATING.period_s
"""Trials run at 100 Hz, too, a usual rate of dVRK clients."""

NOT_CALIBRATED = "this robot could not be calibrated"

Condition = Literal[
    "uncalibrated plan",
    "uncalibrated closed-loop",
    "calibrated plan",
    "calibrated closed-loop",
    "exactly known arms, closed-loop",
]
UNCALIBRATED: tuple[Condition, ...] = ("uncalibrated plan", "uncalibrated closed-loop")
CALIBRATED: tuple[Condition, ...] = ("calibrated plan", "calibrated closed-loop")
EXACT: Condition = "exactly known arms, closed-loop"
"""As a calibration without error would have it: what is left is where things are seen."""

CONDITIONS: tuple[Condition, ...] = (UNCALIBRATED[0], *CALIBRATED, EXACT)


@dataclass(frozen=True)
class Deployment:
    """What is tried.

    Attributes:
        bundle: folder of the policy bundle.
        robots: how many hidden robots; their seeds are `seed`, `seed` + 1, ….
        trials: of each condition on each robot.
        samples: rows of measurements an arm that a robot is calibrated with.
        seed: of the first robot.
        scale: errors of the robots, as a part of those of `calibrate/truths.py`.
        conditions: what is tried on each.
    """

    bundle: Path
    robots: int = 20
    trials: int = 20
    samples: int = 120
    seed: int = 100
    scale: float = 1.0
    conditions: tuple[Condition, ...] = CONDITIONS

    def title(self) -> dict[str, Any]:
        """What two files of trials have to have in common to be one."""
        prepared = _prepared(self.bundle)
        files = [self.bundle / MANIFEST, prepared.cell.files[0]]
        return {
            "bundle": self.bundle.name,
            "bundle_and_cell_sha256": hashlib.sha256(
                b"".join(file.read_bytes() for file in files)
            ).hexdigest(),
            "collect": collecting.VERSION,
            "samples": self.samples,
            "seed": self.seed,
            "rate_hz": round(1.0 / PERIOD_S),
            "scale": self.scale,
            "planned_anew_beyond_m": OFF_PLAN_M,
        }


@dataclass(frozen=True, slots=True)
class Trial:
    """One trial, ready for JSON.

    Attributes:
        robot: seed of the hidden robot.
        number: of the layout.
        start_m: where the block really lay, task frame of the board, x and y.
        seen_off_m: how far from there it was seen, in the plane.
        seen_turned_rad: by what it seemed turned.
        stopped_by: rule for which the gate stepped in; "" if it did not.
        refused: why nothing was run, or the policy's own value of a skill's start that was too low
            to go on; "" otherwise.
    """

    robot: int
    number: int
    condition: Condition
    success: bool
    start_m: tuple[float, float]
    seen_off_m: float
    seen_turned_rad: float
    stopped_by: str
    refused: str
    seconds: float


def run(
    what: Deployment,
    folder: Path,
    processes: int = 1,
    tell: Callable[[str], None] = lambda note: None,
) -> list[Trial]:
    """Runs what is not in the folder yet; every trial is written as soon as it is over.

    Args:
        what: what is tried.
        folder: gets `trials.jsonl` and every robot's measurements and calibration.
        processes: that share the work; the result does not depend on it.
        tell: told what is done.

    Raises:
        CalibrationError: the folder holds trials of something else.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / TRIALS
    done = read_trials(path, what)
    known = {(trial.robot, trial.number, trial.condition) for trial in done}
    robots = range(what.seed, what.seed + what.robots)
    to_calibrate = robots if set(what.conditions) & set(CALIBRATED) else ()
    for note in _each(processes, _calibrate, [(what, folder, robot) for robot in to_calibrate]):
        tell(note)
    wanted = [
        (what, folder, robot, number, condition)
        for robot in robots
        for number in range(what.trials)
        for condition in what.conditions
        if (robot, number, condition) not in known
    ]
    for trial in _each(processes, _try, wanted):
        add_line(path, asdict(trial))
        done.append(trial)
        tell(f"robot {trial.robot}, trial {trial.number}, {trial.condition}: {_came_to(trial)}")
    return [trial for trial in done if trial.robot in robots and trial.number < what.trials]


def _came_to(trial: Trial) -> str:
    return "done" if trial.success else trial.stopped_by or trial.refused or "missed"


def _each(
    processes: int, function: Callable[..., Any], work: Sequence[tuple[Any, ...]]
) -> Iterator[Any]:
    """Results as they come, here or in processes of their own."""
    if processes == 1:
        yield from (function(*arguments) for arguments in work)
        return
    with ProcessPoolExecutor(processes) as pool:
        futures = [pool.submit(function, *arguments) for arguments in work]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def read_trials(path: Path, what: Deployment) -> list[Trial]:
    """Trials that are there already; begins the file where there is none.

    Raises:
        CalibrationError: they are of something else.
    """
    return [_read(row) for row in read_lines(path, what.title())]


def _read(row: dict[str, Any]) -> Trial:
    return Trial(**row | {"start_m": tuple(row["start_m"])})


@functools.cache
def _prepared(bundle: Path) -> Prepared:
    return prepare(bundle)


def _robot(what: Deployment, cell: CellDescription, seed: int) -> HiddenRobot:
    robot = hidden_robot(str(seed), cell)
    return robot if what.scale == 1.0 else replace(robot, truth=scaled(robot.truth, what.scale))


def _file_of(folder: Path, robot: int) -> Path:
    return folder / f"robot-{robot}.json"


def _calibrate(what: Deployment, folder: Path, robot: int) -> str:
    """Measures a robot and writes its calibration, where there is none; says how that went."""
    file = _file_of(folder, robot)
    try:
        if not file.exists():
            _measure(what, folder, robot, file)
    except (CalibrationError, MotionError, SafetyStop) as error:
        return f"robot {robot} is not calibrated: {error}"
    return f"robot {robot} is calibrated"


def _measure(what: Deployment, folder: Path, robot: int, file: Path) -> None:
    cell = _prepared(what.bundle).cell
    hidden, arms = _robot(what, cell, robot), range(len(cell.arms))
    count = poses_for(what.samples)
    poses = np.stack([choose_poses(cell, arm, count, robot) for arm in arms], axis=1)
    with closing(LoopbackDriver(cell, hidden.world(cell, CALIBRATING), robot)) as driver:
        driver.connect()
        driver.reset(_layout(_prepared(what.bundle), robot, 0))
        tracker = SimulatedTracker(driver.world, hidden.tracker(cell), robot)
        line = Line(cell, driver.period_s)
        with Session(cell, driver, line, NoRecord()) as session:
            programme = f"robot {robot}, {count} poses"
            found = collect(session, tracker, poses, folder / f"robot-{robot}", programme)
    fits = {arm.name: fit_arm(arm, load(found.files[arm.name]), robot) for arm in cell.arms}
    now = datetime.datetime.now(datetime.UTC).replace(microsecond=0)
    content = calibration_file(cell, fits, found.files, now, "a simulated tracker")
    whole = file.with_suffix(".part")
    write_calibration(whole, content)
    whole.rename(file)  # a file that is there is whole


def _layout(prepared: Prepared, robot: int, number: int) -> Scene:
    task = prepared.task
    rng = np.random.default_rng([LAYOUTS, robot, number])
    return task.sample_layout(rng, task.distributions[0])


def _try(what: Deployment, folder: Path, robot: int, number: int, condition: Condition) -> Trial:
    """One trial."""
    prepared = _prepared(what.bundle)
    layout = _layout(prepared, robot, number)
    hidden = _robot(what, prepared.cell, robot)
    world = hidden.world(prepared.cell, WorldOptions(period_s=PERIOD_S))
    file, needs_calibration = _file_of(folder, robot), condition in CALIBRATED
    is_ready = file.exists() or not needs_calibration
    cell = prepared.cell
    if needs_calibration and is_ready:
        cell = calibrated(cell, read_calibration(file), file)
    elif condition == EXACT:
        cell = replace(with_errors(cell, hidden.truth.arms), filed=cell)
    prepared = replace(prepared, cell=cell, task=load_task(prepared.task.name, cell))
    mode: Mode = "closed-loop" if condition.endswith("closed-loop") else "plan"
    clock = MonotonicClock()
    began = clock.now()
    driver = LoopbackDriver(prepared.cell, world, 1000 * robot + number)
    driver.connect()
    driver.reset(layout)
    off = driver.world.seeing.error(layout.active)
    result = EpisodeResult(0, refused=NOT_CALIBRATED)
    if is_ready:
        result = _episode(
            prepared, driver, mode, np.random.default_rng([LAYOUTS, robot, number, 1])
        )
    x, y = layout.pose(layout.active)[:2, 3].tolist()
    return Trial(
        robot,
        number,
        condition,
        result.success,
        (x, y),
        float(np.hypot(off[0], off[1])),
        float(off[3]),
        result.stopped_by,
        result.refused or _given_up(result),
        round(clock.now() - began, 2),
    )


def _given_up(result: EpisodeResult) -> str:
    """The value that was too low to go on, if that is how an episode ended."""
    last = result.boundaries[-1] if result.boundaries else None
    if last is None or last.course != "safe pose" or not last.is_value_low:
        return ""
    return f"value {last.value:.2f} before {last.before} is below {last.threshold:.2f}"


def _episode(
    prepared: Prepared, driver: LoopbackDriver, mode: Mode, rng: np.random.Generator
) -> EpisodeResult:
    line = Line(prepared.cell, driver.period_s)
    training = prepared.bundle.manifest.training_range.seen
    with Session(prepared.cell, driver, line, NoRecord(), training) as session:
        try:
            return from_start_pose(session, mode, Job(prepared.bundle, prepared.task, 1), rng, 0)
        except (MotionError, KinematicsError, SafetyStop) as error:  # before anything moved
            session.settle()
            return EpisodeResult(0, refused=str(error))


def of_condition(trials: Sequence[Trial], condition: Condition) -> list[Trial]:
    """The trials of one condition."""
    return [trial for trial in trials if trial.condition == condition]


def by_robot(trials: Sequence[Trial]) -> Iterator[list[Trial]]:
    """The trials of each robot."""
    for robot in sorted({trial.robot for trial in trials}):
        yield [trial for trial in trials if trial.robot == robot]
