"""Plans for arms that no mechanism keeps in their port: one path in space under one clock.

Joints that are smoothed one by one leave the port between two waypoints, by more than a millimetre
where these lie 9 mm apart. Here the chord is resolved every two millimetres, a spline leads through
the joints found, and one jerk-limited clock, the same for all joints, runs along it from rest to
rest. Where the path has a corner, or a jaw starts or stops, the arms rest.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import ruckig
from scipy.interpolate import CubicSpline  # type: ignore[import-untyped]

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import KinematicsError, MotionError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.kinematics.arm import Arm
from viskill_deploy.kinematics.model import forward_batch
from viskill_deploy.kinematics.straight import placed_arm
from viskill_deploy.motion.limits import PlanLimits
from viskill_deploy.motion.resolve import between
from viskill_deploy.motion.smoothing import AxisMotion

SAMPLE_M, SAMPLE_RAD = 0.002, 0.05
"""The path is resolved at least this densely: between, the spline is off the port by micrometres.
One is taken for as much of the path as the other."""

CORNER_RAD = math.radians(20.0)
"""A path that turns by more rests there: its spline would swing out."""

STILL_M = 1e-7
"""A tip that moves by less stands still, and has no direction."""

CLOCK = (1.0, 5.0, 100.0)
"""Speed, acceleration and jerk of a run's clock, per s: full speed in a quarter of a second."""

CHECKS = 40
"""Moments at which each sample's stretch is held against the limits."""


@dataclass(frozen=True, slots=True)
class PathRun:
    """A stretch from rest to rest.

    Attributes:
        start_s: time in the plan at which it starts.
        duration_s: time that it takes.
        scale: real time over that of `clock`.
        clock: Ruckig's trajectory of the way along the path.
        path: splines of all axes over that way, their values (arms, axes), and two derivatives.
    """

    start_s: float
    duration_s: float
    scale: float
    clock: Any
    path: tuple[Any, Any, Any]

    def at(self, t: float) -> tuple[AxisMotion, ...]:
        """State of every arm `t` seconds after the run's start."""
        k = self.scale
        (s,), (v,), (a,) = self.clock.at_time(min(max(t / k, 0.0), self.clock.duration))
        v, a = v / k, a / k**2
        p, slope, bend = (spline(s) for spline in self.path)
        rates, changes = slope * v, bend * v * v + slope * a
        return tuple(
            AxisMotion(tuple(x.tolist()), tuple(y.tolist()), tuple(z.tolist()))
            for x, y, z in zip(p, rates, changes, strict=True)
        )


@dataclass(frozen=True, slots=True)
class _Way:
    """A stretch of path: the length along it of each sample, and of each waypoint, and the joints.

    Lengths are in metres of the tip, or what turning and jaw motion count for.
    """

    lengths: FloatArray
    waypoints: FloatArray
    q: FloatArray


def port_runs(
    cell: CellDescription, q: FloatArray, step_s: float, tip_speed_m_s: float, rests: Sequence[int]
) -> tuple[list[PathRun], list[float]]:
    """The runs of a plan, and the times at which its waypoints are met.

    Args:
        cell: the arms in their places.
        q: axis positions at the waypoints, (n, arms, axes), the first where the arms are.
        step_s: time that each step is meant to take, s.
        tip_speed_m_s: that no tip exceeds.
        rests: waypoints at which all arms have to stand still.

    Raises:
        MotionError: a place between two waypoints is out of reach, or a joint limit is passed.
    """
    arms = [placed_arm(entry) for entry in cell.arms]
    limits = [PlanLimits.of(entry.arm) for entry in cell.arms]
    poses = np.stack(
        [forward_batch(entry.arm, q[:, i, :-1]) for i, entry in enumerate(cell.arms)], axis=1
    )
    stops = _stops(q, poses, rests)
    runs: list[PathRun] = []
    times, now, start = [0.0], 0.0, q[0]
    for first, last in pairwise(stops):
        way = _way(arms, poses[first : last + 1], q[first : last + 1], start)
        _check_inside(limits, way.q, first)
        run = _run(way, limits, now, (last - first) * step_s, tip_speed_m_s)
        runs.append(run)
        times += [now + t for t in _meetings(run, way)]
        now, start = now + run.duration_s, way.q[-1]
    return runs, times


def _stops(q: FloatArray, poses: FloatArray, rests: Sequence[int]) -> list[int]:
    """Waypoints at which the arms rest: the ends, jaws that start or stop, corners, pauses."""
    ways = np.diff(poses[:, :, :3, 3], axis=0)
    lengths = np.linalg.norm(ways, axis=2)
    jaws = np.abs(np.diff(q[:, :, -1], axis=0))
    along = np.einsum("nai,nai->na", ways[:-1], ways[1:])
    moves = lengths > STILL_M
    turned = along < math.cos(CORNER_RAD) * lengths[:-1] * lengths[1:]
    changed = (moves[:-1] != moves[1:]) | (turned & moves[:-1] & moves[1:])
    changed |= np.abs(jaws[:-1] - jaws[1:]) > STILL_M
    inner = np.flatnonzero(changed.any(axis=1)) + 1
    return sorted({0, len(q) - 1, *inner.tolist(), *rests})


def _way(arms: Sequence[Arm], poses: FloatArray, q: FloatArray, start: FloatArray) -> _Way:
    """Samples of the chords through waypoints, each resolved from the one before it."""
    rows, lengths, waypoints = [start], [0.0], [0.0]
    for i in range(len(q) - 1):
        length = _length(poses[i], poses[i + 1], q[i], q[i + 1])
        parts = max(1, math.ceil(length / SAMPLE_M - 1e-9))
        for part in range(1, parts + 1 if length else 1):
            share = part / parts
            row = np.empty_like(start)
            for index, arm in enumerate(arms):
                pose = between(poses[i, index], poses[i + 1, index], share)
                row[index, :-1] = _resolved(arm, pose, rows[-1][index, :-1])
            row[:, -1] = q[i, :, -1] + share * (q[i + 1, :, -1] - q[i, :, -1])
            rows.append(row)
            lengths.append(waypoints[-1] + share * length)
        waypoints.append(waypoints[-1] + length)
    return _Way(np.array(lengths), np.array(waypoints), np.array(rows))


def _resolved(arm: Arm, pose: FloatArray, q: FloatArray) -> FloatArray:
    try:
        return arm.inverse(pose, q)
    except KinematicsError as error:
        raise MotionError(
            f"{arm.description.robot} cannot follow the path between two waypoints: {error}"
        ) from error


def _length(a: FloatArray, b: FloatArray, q: FloatArray, r: FloatArray) -> float:
    """Of one step, m: that of the arm which has most to do."""
    ways = np.linalg.norm(b[:, :3, 3] - a[:, :3, 3], axis=1)
    cosines = (np.einsum("aij,aij->a", a[:, :3, :3], b[:, :3, :3]) - 1.0) / 2.0
    turns = np.arccos(np.clip(cosines, -1.0, 1.0))
    angles = np.maximum(turns, np.abs(r[:, -1] - q[:, -1]))
    length = float(np.maximum(ways, angles * SAMPLE_M / SAMPLE_RAD).max())
    return length if length > STILL_M else 0.0


def _check_inside(limits: Sequence[PlanLimits], q: FloatArray, first: int) -> None:
    for index, limit in enumerate(limits):
        out = (q[:, index] < np.array(limit.lower) - 1e-6) | (
            q[:, index] > np.array(limit.upper) + 1e-6
        )
        if out.any():
            raise MotionError(
                f"the path from waypoint {first} on passes a joint limit; move it away from there, "
                "or start with other joints (start_joints_si)"
            )


def _run(
    way: _Way, limits: Sequence[PlanLimits], start_s: float, meant_s: float, tip_speed_m_s: float
) -> PathRun:
    """The stretch under the fastest clock that keeps all limits and the waypoints' own time."""
    total = float(way.lengths[-1])
    if not total:
        path = CubicSpline([0.0, 1.0], np.stack([way.q[0]] * 2))
    else:
        path = CubicSpline(way.lengths, way.q) if len(way.q) > 2 else _line(way)
    path_of = (path, path.derivative(1), path.derivative(2))
    clock = _clock(total, tip_speed_m_s)
    k = max(1.0, meant_s / max(clock.duration, 1e-9))
    if total:
        k = max(k, _slower(path_of, clock, limits))
    return PathRun(start_s, max(k * clock.duration, meant_s), k, clock, path_of)


def _line(way: _Way) -> Any:
    """A path of two samples as a spline."""
    return CubicSpline(way.lengths, way.q, bc_type="natural")


def _clock(total: float, tip_speed_m_s: float) -> Any:
    """From 0 to the path's length, at rest at both ends, m; of no length where there is no path."""
    request, trajectory = ruckig.InputParameter(1), ruckig.Trajectory(1)
    request.target_position = [total]
    speed, acceleration, jerk = (tip_speed_m_s * rate for rate in CLOCK)
    request.max_velocity, request.max_acceleration = [speed], [acceleration]
    request.max_jerk = [jerk]
    try:
        ruckig.Ruckig(1).calculate(request, trajectory)
    except (ruckig.RuckigError, ValueError) as error:
        raise MotionError(f"no jerk-limited motion: {error}") from error
    return trajectory


def _slower(path: tuple[Any, Any, Any], clock: Any, limits: Sequence[PlanLimits]) -> float:
    """How much slower the clock has to run for every joint to keep its limits."""
    count = max(200, math.ceil(CHECKS * clock.duration / 0.1))
    states = np.array([clock.at_time(t) for t in np.linspace(0.0, clock.duration, count)])
    s, v, a = states[:, 0, 0], states[:, 1, 0], states[:, 2, 0]
    jerk = np.gradient(a, clock.duration / (count - 1))
    slope, bend = path[1](s), path[2](s)
    twist = path[2].derivative(1)(s)
    v, a, jerk = (x[:, None, None] for x in (v, a, jerk))
    speeds = np.abs(slope * v).max(axis=0)
    accelerations = np.abs(bend * v**2 + slope * a).max(axis=0)
    jerks = np.abs(twist * v**3 + 3.0 * bend * v * a + slope * jerk).max(axis=0)
    rows = zip(limits, speeds, accelerations, jerks, strict=True)
    return max(limit.clock(*peaks) for limit, *peaks in rows)


def _meetings(run: PathRun, way: _Way) -> list[float]:
    """Times in the run at which its waypoints but the first are met."""
    count = len(way.waypoints) - 1
    if not way.lengths[-1]:
        return [run.duration_s * (i + 1) / count for i in range(count)]
    times = np.linspace(0.0, run.clock.duration, 20 * count + 200)
    lengths = np.array([run.clock.at_time(t)[0][0] for t in times])
    met = run.scale * np.interp(way.waypoints[1:], lengths, times)
    return [*met[:-1].tolist(), run.duration_s]
