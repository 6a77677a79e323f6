"""The way from wherever the arms were found to their start pose, rehearsed before anybody moves.

Several ways are tried, the plainest first: up and then across, or straight in the joints; all arms
together, or one after the other. Only a way of which a gate has passed every setpoint is taken.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import KinematicsError, MotionError, SafetyStop
from viskill_deploy.core.types import CellState, FloatArray
from viskill_deploy.motion.plan import smooth
from viskill_deploy.motion.resolve import densified, resolve, waypoint_at
from viskill_deploy.runtime.air import start_axes
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.moves import axes_of, stream, way_to_start
from viskill_deploy.runtime.operator import Operator
from viskill_deploy.runtime.planning import Plan
from viskill_deploy.runtime.resuming import resumed
from viskill_deploy.runtime.session import Session

THERE = 1e-3
"""Rad or m: arms whose axes are all within this of their start pose are in it."""

STEP_RAD = 0.2
"""Largest joint motion between two waypoints: a chord in the joints is no chord in space."""

STEP_M = 0.008

INSERTION = 2


def approach(session: Session, result: EpisodeResult, operator: Operator | None = None) -> bool:
    """Takes the arms to their start pose, jaws closed, with the operator's consent.

    The arms are ready and not armed, and so they are afterwards.

    Args:
        session: the arms.
        result: told how it went.
        operator: who may resume after a HOLD; None for nobody.

    Returns:
        False when the gate stepped in; `result` says for what.

    Raises:
        MotionError: no way there is known.
        SafetyStop: the gate would pass none of the ways, or refuses to arm.
    """
    plan = approach_plan(session, session.driver.state())
    if plan is None:
        return True

    def look() -> Callable[[], Plan | None]:
        return partial(approach_plan, session, session.read())

    session.begin()
    while plan is not None and not stream(session, plan):
        session.come_to_rest(result)
        plan = resumed(session, operator, result, look)
        if result.stopped_by:
            return False
    session.finish()
    result.stopped_by = session.cause
    return not session.cause


def approach_plan(session: Session, state: CellState) -> Plan | None:
    """The first of the ways that a gate passes as a whole; None when the arms are there.

    Raises:
        MotionError, SafetyStop: there is none; says what was wrong with the last.
    """
    cell, held = session.cell, axes_of(state)
    if np.abs(start_axes(cell, held) - held).max() <= THERE:
        return None
    _insist_on_insertion(cell, held)
    refused: Exception = MotionError("there is no way")
    for rows in _ways(cell, held):
        try:
            plan = _along(cell, rows)
            session.check(plan, state)
        except (MotionError, KinematicsError, SafetyStop) as error:
            refused = error
        else:
            return plan
    kind = type(refused) if isinstance(refused, (MotionError, SafetyStop)) else MotionError
    raise kind(
        f"no way to the start pose: {refused}; move the instruments nearer to it by hand, clear of "
        "the board, and start again"
    )


def _along(cell: CellDescription, rows: FloatArray) -> Plan:
    """The plan through axis positions (n, arms, 7), from rest to rest."""
    motion = smooth(cell, rows, cell.file.motion.step_s)
    may_open = (True,) * len(cell.arms)  # nothing is held yet
    waypoints = (replace(waypoint_at(cell, row), may_open_jaw=may_open) for row in rows)
    return Plan(tuple(waypoints), motion, {})


def _ways(cell: CellDescription, held: FloatArray) -> Iterator[FloatArray]:
    """Axis positions along the ways from `held` (arms, 7) to the start pose, (n, arms, 7) each."""
    for way in (_up_and_across, _straight):
        try:
            rows = way(cell, held)
        except (MotionError, KinematicsError):
            continue
        yield rows
        for order in itertools.permutations(range(len(cell.arms))) if len(cell.arms) > 1 else ():
            yield _one_by_one(rows, order)


def _insist_on_insertion(cell: CellDescription, held: FloatArray) -> None:
    for arm, row in zip(cell.arms, held, strict=True):
        least = arm.arm.insertion_min_m
        if not row[INSERTION] >= least:
            raise MotionError(
                f"{arm.name}'s instrument ends inside its cannula (insertion "
                f"{1e3 * row[INSERTION]:.1f} mm, at least {1e3 * least:.1f}); insert it by hand, "
                "clear of the board, and start again"
            )


def _up_and_across(cell: CellDescription, held: FloatArray) -> FloatArray:
    way = densified(way_to_start(cell, waypoint_at(cell, held)))
    return resolve(cell, way[1:], held.tolist())


def _straight(cell: CellDescription, held: FloatArray) -> FloatArray:
    return between(held, start_axes(cell, held))


def between(start: FloatArray, goal: FloatArray) -> FloatArray:
    """Axis positions from `start` to `goal`, (arms, 7) each, evenly and in small steps."""
    largest = np.full(start.shape[1], STEP_RAD)
    largest[INSERTION] = STEP_M
    steps = max(1, math.ceil(float((np.abs(goal - start) / largest).max())))
    rows: FloatArray = np.array([start + (goal - start) * (k / steps) for k in range(steps + 1)])
    return rows


def _one_by_one(rows: FloatArray, order: Sequence[int]) -> FloatArray:
    """The same way, one arm after the other."""
    parts, now = [rows[:1]], rows[0]
    for arm in order:
        part = np.repeat(now[None], len(rows) - 1, axis=0)
        part[:, arm] = rows[1:, arm]
        parts.append(part)
        now = part[-1]
    return np.concatenate(parts)
