"""Measuring: the arms visit poses through the gate, and something else sees their tips."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Protocol

import numpy as np

from viskill_deploy.calibrate.books import Book
from viskill_deploy.calibrate.measurements import Measurements
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import Interrupted, MotionError, SafetyStop, ViskillError
from viskill_deploy.core.types import CellState, FloatArray
from viskill_deploy.kinematics.model import tip_positions
from viskill_deploy.motion.plan import smooth
from viskill_deploy.motion.resolve import waypoint_at
from viskill_deploy.runtime.approach import approach
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.moves import axes_of
from viskill_deploy.runtime.operator import Operator
from viskill_deploy.runtime.planning import Plan
from viskill_deploy.runtime.resuming import resumed
from viskill_deploy.runtime.session import Session

REST_STEPS = 2
"""Policy steps that the arms rest at a pose before it is measured: 0.4 s."""

MOVING_EVERY = 2
"""Half of the poses, those with the fastest ways, are also measured on the way to them: only
moving joints show a delay."""

LOOKS = 12
"""Moments of a way at which its speed is looked at."""

TURN_RAD = 1e-3
"""A wrist joint that moved by less has not turned."""

STEP_RAD = 0.4
"""Largest joint motion in one policy step: a wrist that turns at its full speed would swing the arm
behind it beyond its jerk limit."""

STALE_S = 0.15
"""A point that was seen longer ago is none: the arms were elsewhere."""

PARABOLA_S = 0.06
"""So long a part of a way is taken for a parabola: more than what a tracker's stamps are late."""

FEWEST, SPAN = 4, 0.7
"""States that a parabola needs, which has three numbers, and the part of `PARABOLA_S` that they
have to cover."""

VERSION = 2
"""Of what is measured, and how: rows of another version are no part of the same study."""

TINY_S = 1e-9
"""Rounding of stamps."""

BLIND_POSES = 3
"""A tracker that is covered at a pose is soon free again; one that stays blind is not."""

BLOCKED = "S17"
"""Rule that stops an arm which does not follow: something is in its way to a pose."""

AGAIN = "what was measured is kept, put the cause right and start again"

LOT = 8
"""Poses that are planned and rehearsed together."""


class PointSource(Protocol):
    """Something that sees the tips: a tracker, a simulator, a person with a ruler.

    Attributes:
        point_m: how far beyond the jaw pivot, along the tip, what it sees is. At 0 it cannot tell
            how a wrist is turned about its last joint.
    """

    point_m: float

    def look(self, now: float) -> None:
        """Called in every control period, for sources that have to keep up."""
        ...

    def points(self, now: float) -> Mapping[str, tuple[float, FloatArray]]:
        """When each arm's point was seen, and where, by arm; arms that it misses are left out.

        Args:
            now: driver's clock, s, by which stamps are as well; points are (3,) m, task frame.
        """
        ...


@dataclass(frozen=True)
class Collected:
    """How a collection went.

    Attributes:
        files: measurements of each arm.
        measured: poses that were measured, those of earlier calls included.
        skipped: poses that the gate's rehearsal refused, or that an arm could not get to.
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
    progress: Callable[[str, int], None] = lambda what, count: None,
    operator: Operator | None = None,
) -> Collected:
    """Visits poses and writes what is measured there, a row at a time; goes on where it was.

    The arms go to their start pose first. All is planned and rehearsed there, before they move on:
    arms that are on their way cannot wait for a plan.

    Args:
        session: a connected cell.
        source: sees the tips.
        poses: joints to visit, (n, arms, 6).
        folder: gets `<arm>.csv`; rows that are there already are kept, and their poses left out.
        programme: says how the poses were chosen; a folder of another programme is refused.
        progress: told how many poses are "planned", and how many "measured".
        operator: who may resume after a HOLD; None for nobody.

    Raises:
        CalibrationError: the folder holds another programme's measurements.
        MotionError: there is no way to the start pose.
        SafetyStop: the gate stepped in; what was measured so far is kept.
        Interrupted: a person has ended it; the same.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = {arm.name: folder / f"{arm.name}.csv" for arm in session.cell.arms}
    books = [Book(files[arm.name], programme, arm, source.point_m) for arm in session.cell.arms]
    result = EpisodeResult(0)

    def look() -> Callable[[], list[_Visits]]:
        first = min(book.done for book in books)
        return partial(_planned, session, session.read(), poses, first, progress)

    try:
        session.make_ready()
        if not approach(session, result, operator):
            raise _ended(session, result.stopped_by)
        lots = look()()
        if lots:
            session.begin()
        while lots:
            if _stream(session, source, lots[0], books):
                lots.pop(0)
                progress("measured", books[-1].visited)
                continue
            session.come_to_rest(result)
            if result.stopped_by == BLOCKED:
                for book in books:
                    book.give_up(book.done)
            cause = ": ".join(filter(None, (result.stopped_by, result.reason)))
            rest: list[_Visits] | None = resumed(session, operator, result, look)
            if rest is None:
                raise _ended(session, cause)
            lots = rest
            for book in books:
                book.unseen = 0
        session.finish()
    finally:
        for book in books:
            book.close()
    visited = books[-1].visited
    return Collected(files, visited, len(poses) - visited)


def _ended(session: Session, cause: str) -> ViskillError:
    """Why nothing more is measured: a person's wish, or the gate's."""
    if session.is_stop_wanted:
        return Interrupted("stopped; what was measured is kept, start again to go on")
    return SafetyStop(f"the gate stepped in ({cause}); {AGAIN}")


def _planned(
    session: Session,
    state: CellState,
    poses: FloatArray,
    index: int,
    progress: Callable[[str, int], None],
) -> list[_Visits]:
    """Checked plans through the poses from `index` on, those left out that a gate refuses."""
    lots = list[_Visits]()
    while index < len(poses):
        session.go_on()
        visits = _next_lot(session, state, poses, index)
        if visits is None:
            index += 1
            continue
        lots.append(visits)
        state = _resting(state, visits.rows[-1])
        index += len(visits.arrivals)
        progress("planned", index)
    return lots


def _resting(state: CellState, row: FloatArray) -> CellState:
    """The same arms at rest at axis positions (arms, 7)."""
    arms = []
    for arm, axes in zip(state.arms, row.tolist(), strict=True):
        jp, jaw = tuple(axes[:6]), axes[6]
        arms.append(replace(arm, measured_jp=jp, setpoint_jp=jp, jaw_setpoint_jp=jaw))
    return replace(state, arms=tuple(arms))


def _next_lot(session: Session, state: CellState, poses: FloatArray, index: int) -> _Visits | None:
    """A checked plan through the next poses, or the next one alone; None when that is refused."""
    for count in (LOT, 1):
        try:
            return _visits(session, state, poses[index : index + count], index)
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
        first: number of the first of the poses.
    """

    plan: Plan
    rows: FloatArray
    arrivals: tuple[int, ...]
    first: int


def _visits(session: Session, state: CellState, poses: FloatArray, first: int) -> _Visits:
    """Plans and rehearses, from a state at rest: to each pose, and a rest there."""
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
    session.check(plan, state)
    return _Visits(plan, table, tuple(arrivals), first)


def _stream(session: Session, source: PointSource, visits: _Visits, books: list[Book]) -> bool:
    """Streams a lot and measures on the way; False when the gate stepped in."""
    look_back = math.ceil((STALE_S + PARABOLA_S) / session.driver.period_s) + 2
    due, past = _moments(session.cell, visits), deque[CellState](maxlen=look_back)
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
            return False
        past.append(session.read())
        source.look(session.driver.clock.now())
        if due and session.line.phase >= due[0][0]:
            _, pose, is_moving = due.pop(0)
            _measure(past, source, session.driver.clock.now(), books, turns, pose, is_moving)
            for arm, book in zip(session.cell.arms, books, strict=True):
                if book.unseen >= BLIND_POSES:
                    session.line.fail(f"nobody has seen {arm.name} at {BLIND_POSES} poses running")
    return True


def _moments(cell: CellDescription, visits: _Visits) -> list[tuple[float, int, bool]]:
    """When to measure: plan time, pose, and whether on the way to it."""
    first, times = visits.first, visits.plan.motion.waypoint_times
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
    past: Sequence[CellState],
    source: PointSource,
    now: float,
    books: list[Book],
    turns: FloatArray,
    pose: int,
    is_moving: bool,
) -> None:
    points = source.points(now)
    for index, (book, turn) in enumerate(zip(books, turns, strict=True)):
        seen_s, point = points.get(past[-1].arms[index].name, (-math.inf, np.zeros(3)))
        row = joints = None
        if now - seen_s <= STALE_S and np.isfinite(point).all():
            joints = _moving_at(past, index, seen_s) if is_moving else _still_at(past, index)
        if joints is not None:
            jp, jv, ja = joints
            row = Measurements(
                np.array([seen_s]),
                jp[None],
                jv[None],
                turn[None],
                np.asarray(point)[None],
                accelerations=ja[None],
            )
        book.write(pose, is_moving, row)


def _still_at(past: Sequence[CellState], arm: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The joints of an arm at rest, and no speeds or accelerations, (6,) each."""
    return np.array(past[-1].arms[arm].measured_jp), np.zeros(6), np.zeros(6)


def _moving_at(
    past: Sequence[CellState], arm: int, time: float
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """An arm's joints, speeds and accelerations, (6,) each, at a time among its last states'.

    None where too little is known of the time before it. A state that was read twice counts once.

    They are those of the parabola through the positions of the last `PARABOLA_S`, which is also
    what the fit takes for where the joints were a delay ago. Reported speeds are left alone: they
    are those of a moment, and a servo that follows a staircase is slower at the end of each step.
    """
    stamps, first = np.unique([state.arms[arm].stamp_s for state in past], return_index=True)
    joints = np.array([past[index].arms[arm].measured_jp for index in first])
    ages = stamps - time
    near = (ages >= -PARABOLA_S - TINY_S) & (ages <= TINY_S)
    if near.sum() < FEWEST or np.ptp(ages[near]) < SPAN * PARABOLA_S:
        return None
    curve, speed, place = np.polyfit(ages[near], joints[near], 2)
    return place, speed, 2.0 * curve
