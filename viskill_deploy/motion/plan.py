"""A whole plan: waypoints known in advance, resolved to joints and smoothed.

The plan is cut into runs that begin and end at rest: at its ends, where every axis pauses or turns,
and where a jaw starts or stops moving. Each run is drawn by Ruckig at fixed rates that belong to no
arm, at the smallest time scale k at which its profiles reach every waypoint, and then slowed, as a
whole, until every joint keeps its limits and the tip its speed. Limits change the clock alone, so
the path in space stays the same.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from viskill_deploy.core.description import PLAN_FRACTION, CellDescription
from viskill_deploy.core.errors import MotionError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.kinematics.model import forward_batch
from viskill_deploy.motion.limits import PlanLimits
from viskill_deploy.motion.port_path import PathRun, port_runs
from viskill_deploy.motion.smoothing import AxisMotion, inside, is_direct, peaks, travel_time

SCALE_STEP = 1.15
"""Growth of the shape time scale from one try to the next."""

MAX_SCALE = 60.0

STILL = 1e-9
"""Axis travel, rad or m, below which an axis counts as pausing."""


@dataclass(frozen=True, slots=True)
class Run:
    """Consecutive segments from rest to rest under one clock.

    Attributes:
        start_s: time in the plan at which it starts.
        scale: real time over the time in which `segments` are written, >= 1.
        step_s: duration of each segment before scaling.
        first: index of the first waypoint.
        segments: per step one Ruckig trajectory an arm.
    """

    start_s: float
    scale: float
    step_s: float
    first: int
    segments: tuple[tuple[Any, ...], ...]

    @property
    def duration_s(self) -> float:
        """Time that the run takes."""
        return len(self.segments) * self.step_s * self.scale

    def at(self, t: float) -> tuple[AxisMotion, ...]:
        """State of every arm `t` seconds after the run's start."""
        k = self.scale
        local = min(max(t / k, 0.0), len(self.segments) * self.step_s)
        index = min(int(local / self.step_s), len(self.segments) - 1)
        states = []
        for trajectory in self.segments[index]:
            p, v, a = trajectory.at_time(min(local - index * self.step_s, trajectory.duration))
            states.append(AxisMotion(tuple(p), tuple(x / k for x in v), tuple(x / k**2 for x in a)))
        return tuple(states)


@dataclass(frozen=True, slots=True)
class JointPlan:
    """A smoothed plan of all arms.

    Attributes:
        runs: in order, from rest to rest.
        waypoint_times: time at which each waypoint is met, (waypoints,) s.
        stretch: time of the plan over the time that its waypoints meant, >= 1.
    """

    runs: tuple[Run | PathRun, ...]
    waypoint_times: tuple[float, ...]
    stretch: float

    @property
    def duration_s(self) -> float:
        """Time that the plan takes."""
        return self.waypoint_times[-1]

    def at(self, t: float) -> tuple[AxisMotion, ...]:
        """State of every arm at plan time `t`, s; at its ends for times outside."""
        index = max(bisect_right(self.runs, t + 1e-12, key=lambda run: run.start_s) - 1, 0)
        return self.runs[index].at(t - self.runs[index].start_s)

    def table(self, period_s: float) -> FloatArray:
        """Positions, velocities, accelerations after each control period, (n, arms, 3, axes)."""
        count = math.ceil(self.duration_s / period_s - 1e-9)
        times = [(i + 1) * period_s for i in range(count)]
        return np.array([[(m.p, m.v, m.a) for m in self.at(t)] for t in times])


def waypoint_velocities(q: FloatArray, step_s: float) -> FloatArray:
    """Axis velocities at the waypoints, same shape as `q` (n, arms, axes).

    Central differences, lowered to at most 1.5 times the slower neighbour so that no axis
    overshoots, zero at a turn, at the ends, and for all axes wherever a jaw starts or stops.
    """
    d = np.diff(q, axis=0) / step_s
    before, after = d[:-1], d[1:]
    least = np.minimum(np.abs(before), np.abs(after))
    central = np.minimum(np.abs(before + after) / 2, 1.5 * least)
    inner = np.where(before * after > 0, np.sign(before) * central, 0.0)
    jaw_changes = (np.abs(before[..., -1] - after[..., -1]) * step_s > STILL).any(axis=1)
    inner[jaw_changes] = 0.0
    v = np.zeros_like(q)
    v[1:-1] = inner
    return v


@dataclass(frozen=True, slots=True)
class Part:
    """A stretch of a motion that begins and ends at rest, as a motion of its own.

    Attributes:
        motion: the whole.
        start_s: time in it at which the part begins.
        duration_s: the part's length.
    """

    motion: JointPlan
    start_s: float
    duration_s: float

    def at(self, t: float) -> tuple[AxisMotion, ...]:
        """State of every arm `t` seconds after the part's start; at its ends for times outside."""
        return self.motion.at(self.start_s + min(max(t, 0.0), self.duration_s))


def smooth(
    cell: CellDescription,
    q: FloatArray,
    step_s: float,
    speed: float = 1.0,
    rests: Sequence[int] = (),
) -> JointPlan:
    """A jerk-limited plan through joint waypoints.

    Args:
        cell: the arms, their limits and the tip speed.
        q: axis positions at the waypoints, (n, arms, axes), the first where the arms are; n >= 2.
        step_s: time that each step is meant to take.
        speed: part of the planned tip speed to use, in (0, 1].
        rests: waypoints at which all arms have to stand still.

    Raises:
        MotionError: fewer than two waypoints, a number that is not finite, or no motion inside the
            limits.
    """
    q = np.asarray(q, dtype=np.float64)
    if q.ndim != 3 or q.shape[0] < 2 or q.shape[1:] != (len(cell.arms), cell.arms[0].arm.axes):
        raise MotionError(f"a plan needs waypoints of shape (n >= 2, arms, axes), got {q.shape}")
    if not np.isfinite(q).all() or not (0.0 < speed <= 1.0 and step_s > 0.0):
        raise MotionError("waypoints must be finite, speed in (0, 1] and step_s positive")
    tip_speed_m_s = PLAN_FRACTION * speed * cell.file.motion.tip_speed_m_s
    if not all(arm.arm.has_remote_centre for arm in cell.arms):
        paths, met = port_runs(cell, q, step_s, tip_speed_m_s, rests)
        return JointPlan(tuple(paths), tuple(met), met[-1] / (step_s * (len(q) - 1)))
    limits = tuple(PlanLimits.of(arm.arm) for arm in cell.arms)
    v = waypoint_velocities(q, step_s)
    v[list(rests)] = 0.0
    runs: list[Run] = []
    times, now = [0.0], 0.0
    for first, last in _rest_to_rest(v):
        run = _drawn(limits, q[first : last + 1], v[first : last + 1], step_s, now, first)
        run = _slowed(run, cell, tip_speed_m_s)
        runs.append(run)
        times += [now + (i + 1) * step_s * run.scale for i in range(last - first)]
        now = times[-1]
    return JointPlan(tuple(runs), tuple(times), now / (step_s * (len(q) - 1)))


def _rest_to_rest(v: FloatArray) -> Iterator[tuple[int, int]]:
    at_rest = np.flatnonzero((np.abs(v) <= STILL).all(axis=(1, 2)))
    yield from zip(at_rest[:-1].tolist(), at_rest[1:].tolist(), strict=True)


def _drawn(
    limits: Sequence[PlanLimits],
    q: FloatArray,
    v: FloatArray,
    step_s: float,
    start_s: float,
    first: int,
) -> Run:
    k = 1.0
    while k <= MAX_SCALE:
        segments = _segments([limit.shape().faster(k) for limit in limits], q, v, step_s)
        if segments is not None:
            return Run(start_s, _clock(limits, segments), step_s, first, segments)
        k *= SCALE_STEP
    raise MotionError(
        f"steps {first} to {first + len(q) - 1} cannot be smoothed inside the joint limits, "
        "not even slowly; put more waypoints between them"
    )


def _segments(
    limits: Sequence[PlanLimits], q: FloatArray, v: FloatArray, step_s: float
) -> tuple[tuple[Any, ...], ...] | None:
    rows = []
    rest = (0.0,) * q.shape[2]
    for i in range(len(q) - 1):
        row = []
        for arm, limit in enumerate(limits):
            start = AxisMotion(tuple(q[i, arm]), tuple(v[i, arm]), rest)
            if np.any(np.abs(v[i : i + 2, arm]) > limit.velocity):
                return None
            trajectory = travel_time(limit, start, q[i + 1, arm], v[i + 1, arm], step_s)
            if trajectory.duration > step_s + 1e-9:
                return None
            if not is_direct(trajectory, start, q[i + 1, arm]):
                return None
            if not inside(limit, trajectory):
                raise MotionError(f"step {i} passes a joint limit; move its waypoints away from it")
            row.append(trajectory)
        rows.append(tuple(row))
    return tuple(rows)


def _clock(limits: Sequence[PlanLimits], segments: Sequence[tuple[Any, ...]]) -> float:
    """The slower clock, >= 1, under which every arm keeps its limits on these segments."""
    slowest = 1.0
    for row in segments:
        for limit, trajectory in zip(limits, row, strict=True):
            slowest = max(slowest, limit.clock(*peaks(trajectory)))
    return slowest


def _slowed(run: Run, cell: CellDescription, tip_speed_m_s: float) -> Run:
    """The same run with a slower clock, so that no tip is faster than `tip_speed_m_s`."""
    count = max(2, 40 * len(run.segments))
    times = np.linspace(0.0, run.duration_s, count + 1)
    q = np.array([[m.p[:-1] for m in run.at(t)] for t in times])
    fastest = 0.0
    for index, arm in enumerate(cell.arms):
        steps = np.diff(forward_batch(arm.arm, q[:, index])[:, :3, 3], axis=0)
        fastest = max(fastest, float(np.sqrt((steps**2).sum(axis=1).max())))
    slower = max(1.0, fastest / (run.duration_s / count) / tip_speed_m_s)
    return Run(run.start_s, run.scale * slower, run.step_s, run.first, run.segments)
