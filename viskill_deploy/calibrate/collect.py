"""Measuring: the arms visit poses through the gate, and something else sees their tips."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Protocol

import numpy as np

from viskill_deploy.calibrate import measurements
from viskill_deploy.calibrate.measurements import Measurements
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import CalibrationError, MotionError, SafetyStop
from viskill_deploy.core.types import CellState, FloatArray
from viskill_deploy.kinematics.model import tip_positions
from viskill_deploy.motion.plan import smooth
from viskill_deploy.motion.resolve import waypoint_at
from viskill_deploy.runtime.moves import axes_of
from viskill_deploy.runtime.planning import Plan
from viskill_deploy.runtime.session import Session

REST_STEPS = 2
"""Policy steps that the arms rest at a pose before it is measured: 0.4 s."""

MOVING_EVERY = 3
"""A third of the poses, those with the fastest ways, are also measured on the way to them: only
moving joints show a delay."""

LOOKS = 12
"""Moments of a way at which its speed is looked at."""

TURN_RAD = 1e-3
"""A wrist joint that moved by less has not turned."""

STEP_RAD = 0.4
"""Largest joint motion in one policy step: a wrist that turns at its full speed would swing the arm
behind it beyond its jerk limit."""

LOT = 8
"""Poses that are planned and rehearsed together."""


class PointSource(Protocol):
    """Something that sees the tips: a tracker, a simulator, a person with a ruler."""

    def look(self, now: float) -> None:
        """Called in every control period, for sources that have to keep up."""
        ...

    def points(self, now: float) -> Mapping[str, FloatArray]:
        """Where each arm's point is, task frame, (3,) m, by arm; arms that it misses are left out.

        Args:
            now: driver's clock, s.
        """
        ...


@dataclass(frozen=True)
class Collected:
    """How a collection went.

    Attributes:
        files: measurements of each arm.
        measured: poses that were measured, those of earlier calls included.
        skipped: poses that the gate's rehearsal refused.
    """

    files: Mapping[str, Path]
    measured: int
    skipped: int


def collect(
    session: Session,
    source: PointSource,
    poses: FloatArray,
    folder: Path,
    programme: str,
    progress: Callable[[int], None] = lambda count: None,
) -> Collected:
    """Visits poses and writes what is measured there, a row at a time; goes on where it was.

    Args:
        session: a connected cell.
        source: sees the tips.
        poses: joints to visit, (n, arms, 6).
        folder: gets `<arm>.csv`; rows that are there already are kept, and their poses left out.
        programme: says how the poses were chosen; a folder of another programme is refused.
        progress: told how many poses are measured.

    Raises:
        CalibrationError: the folder holds another programme's measurements.
        SafetyStop: the gate stepped in; what was measured so far is kept.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = {arm.name: folder / f"{arm.name}.csv" for arm in session.cell.arms}
    books = [_Book(path, programme) for path in files.values()]
    done = min(book.done for book in books)
    skipped = 0
    try:
        session.make_ready()
        session.begin()
        index = done
        while index < len(poses):
            lot = _next_lot(session, poses, index)
            if lot is None:
                skipped += 1
                index += 1
                continue
            plan, count = lot
            _stream(session, source, plan, books, index)
            index += count
            progress(index - skipped)
        session.finish()
    finally:
        for book in books:
            book.close()
    return Collected(files, len(poses) - skipped, skipped)


def _next_lot(session: Session, poses: FloatArray, index: int) -> tuple[_Visits, int] | None:
    """A checked plan through the next poses, or the next one alone; None when that is refused."""
    for count in (LOT, 1):
        lot = poses[index : index + count]
        try:
            return _visits(session, lot), len(lot)
        except (MotionError, SafetyStop):
            continue
    return None


@dataclass(frozen=True)
class _Visits:
    """A plan through poses.

    Attributes:
        plan: the plan.
        rows: axis positions at its waypoints, (n, arms, 7).
        arrivals: index of the waypoint at which each pose is reached.
    """

    plan: Plan
    rows: FloatArray
    arrivals: tuple[int, ...]


def _visits(session: Session, poses: FloatArray) -> _Visits:
    """Plans and rehearses: to each pose, and a rest there."""
    state = session.read()
    held = axes_of(state)
    rows, arrivals = [held], []
    for pose in poses:
        last, goal = rows[-1], held.copy()
        goal[:, :6] = pose
        steps = max(1, math.ceil(float(np.abs(goal - last).max()) / STEP_RAD))
        rows += [last + (goal - last) * (k / steps) for k in range(1, steps)]
        arrivals.append(len(rows))
        rows += [goal] * (1 + REST_STEPS)
    table = np.array(rows)
    cell: CellDescription = session.cell
    motion = smooth(cell, table, cell.file.motion.step_s)
    plan = Plan(tuple(waypoint_at(cell, row) for row in rows), motion, {})
    plan.check(cell, session.driver.period_s, state, session.line.ik_solver)
    return _Visits(plan, table, tuple(arrivals))


def _stream(
    session: Session, source: PointSource, visits: _Visits, books: list[_Book], first: int
) -> None:
    """Streams a lot and measures on the way."""
    due = _moments(session.cell, visits, first)
    motion = visits.plan.motion
    turns = np.zeros((len(books), 3))
    session.line.follow(motion)
    row = 0
    while not session.line.arrived:
        while row + 1 < len(visits.rows) and motion.waypoint_times[row] <= session.line.phase:
            change = np.diff(visits.rows[row : row + 2, :, 3:6], axis=0)[0]
            turns = np.where(np.abs(change) > TURN_RAD, np.sign(change), turns)
            row += 1
        if not session.cycle():
            session.come_to_rest()
            raise SafetyStop(
                f"the gate stepped in ({session.cause}); what was measured is kept, put the cause "
                "right and start again"
            )
        now = session.driver.clock.now()
        source.look(now)
        if due and session.line.phase >= due[0][0]:
            _, pose, is_moving = due.pop(0)
            _measure(
                session.read(), source, session.driver.clock.now(), books, turns, pose, is_moving
            )


def _moments(cell: CellDescription, visits: _Visits, first: int) -> list[tuple[float, int, bool]]:
    """When to measure: plan time, pose, and whether on the way to it."""
    times = visits.plan.motion.waypoint_times
    at_rest = [times[there + REST_STEPS] for there in visits.arrivals]
    left = [0.0, *at_rest[:-1]]
    ways = [
        _fastest(cell, visits, start, times[there])
        for start, there in zip(left, visits.arrivals, strict=True)
    ]
    slowest_first = sorted(range(len(ways)), key=lambda pose: ways[pose][1])
    moving = slowest_first[-math.ceil(len(ways) / MOVING_EVERY) :]
    moments = [(ways[pose][0], first + pose, True) for pose in moving]
    moments += [(time - 1e-6, first + pose, False) for pose, time in enumerate(at_rest)]
    return sorted(moments)


def _fastest(
    cell: CellDescription, visits: _Visits, start: float, end: float
) -> tuple[float, float]:
    """When on a way the slower of the arms' tips is fastest, and how fast that is, s and m/s."""
    times = np.linspace(start, end, LOOKS)
    axes = np.array([[arm.p for arm in visits.plan.motion.at(time)] for time in times])
    speeds = []
    for index, arm in enumerate(cell.arms):
        steps = np.diff(tip_positions(arm.arm, axes[:, index, :6]), axis=0)
        speeds.append(np.linalg.norm(steps, axis=1) / (times[1] - times[0]))
    slower = np.min(speeds, axis=0)
    best = int(np.argmax(slower))
    return float(times[best] + times[best + 1]) / 2.0, float(slower[best])


def _measure(
    state: CellState,
    source: PointSource,
    now: float,
    books: list[_Book],
    turns: FloatArray,
    pose: int,
    is_moving: bool,
) -> None:
    points = source.points(now)
    for arm, book, turn in zip(state.arms, books, turns, strict=True):
        point = points.get(arm.name)
        row = None
        if point is not None and np.isfinite(point).all():
            row = Measurements(
                np.array([now]),
                np.array([arm.measured_jp]),
                np.array([arm.measured_jv]) if is_moving else np.zeros((1, 6)),
                turn[None],
                np.asarray(point)[None],
            )
        book.write(pose, is_moving, row)


class _Book:
    """The CSV file of one arm, a row at a time.

    Attributes:
        done: poses that need no more visit.
    """

    def __init__(self, path: Path, programme: str) -> None:
        title = f"# programme: {programme}\n"
        self.done = 0
        if path.exists():
            self.done = _resume(path, title)
            self._file: IO[str] = path.open("a", encoding="utf-8")
        else:
            self._file = path.open("w", encoding="utf-8")
            self._file.write(title + measurements.header())

    def write(self, pose: int, is_moving: bool, row: Measurements | None) -> None:
        """Writes a row to the disk; a comment once a pose is done, seen or not."""
        if row is not None:
            self._file.write(measurements.line(row, 0))
        if not is_moving:
            self._file.write(f"# pose {pose} done\n")
            self._file.flush()
            os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()


def _resume(path: Path, title: str) -> int:
    """Cuts a file off after the last pose that was done; how many poses that leaves.

    Raises:
        CalibrationError: it was written by another programme.
    """
    text = path.read_text(encoding="utf-8")
    if not text.startswith(title):
        raise CalibrationError(
            f"{path}: holds measurements of another programme; name another folder"
        )
    ends = list(re.finditer(r"^# pose (\d+) done\n", text, re.MULTILINE))
    kept = text[: ends[-1].end()] if ends else title + measurements.header()
    path.write_text(kept, encoding="utf-8")
    return int(ends[-1].group(1)) + 1 if ends else 0
