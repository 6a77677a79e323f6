"""One segment: a jerk-limited motion of the whole cell from its present state to a waypoint.

Community Ruckig has no waypoints, no position limits and no tracking mode, so every segment is one
state-to-state calculation an arm with `minimum_duration`, both arms ending together; position
extrema and tip speed are checked here. Where the limits need more time than the policy's step, the
segment takes longer and says so (`stretch`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import ruckig

from viskill_deploy.core.description import PLAN_FRACTION, CellDescription
from viskill_deploy.core.errors import MotionError
from viskill_deploy.core.types import FloatArray, Joints, JointSetpoint
from viskill_deploy.kinematics.model import forward_batch
from viskill_deploy.motion.limits import PlanLimits

AXES = 7
"""A PSM's: six joints and the jaw."""

ATTEMPTS = 12
LAST_FAST_ATTEMPT = 7
"""After this many attempts the end velocity is given up: the segment ends at rest."""

DUST, DUST_S = 1e-7, 1e-3
"""Speeds (per s) and differences of position below DUST, rad or m, are rounding errors; so are
accelerations below DUST in DUST_S."""

SWING = 1e-4
"""Rad or m by which an axis may pass its ends without a speed that explains it."""

TIP_SAMPLES = 16

TIP_TOLERANCE = 1.03
"""Tip speed may pass the planned one by this, still 7 % below the gate's: a segment that starts at
the planned speed must not stretch for ever over a rounding error."""


@dataclass(frozen=True, slots=True)
class AxisMotion:
    """Position, velocity and acceleration of an arm's axes (jaw last), rad or m, s."""

    p: Joints
    v: Joints
    a: Joints

    @classmethod
    def at_rest(cls, p: Sequence[float]) -> AxisMotion:
        """No motion at `p`."""
        return cls(tuple(p), (0.0,) * len(p), (0.0,) * len(p))

    def setpoint(self) -> JointSetpoint:
        """What is sent for this state."""
        return JointSetpoint(self.p[:-1], self.v[:-1], self.p[-1], self.v[-1])


@dataclass(frozen=True, slots=True)
class Segment:
    """A motion of all arms over `duration_s`, a whole number of control periods.

    Attributes:
        duration_s: time from its start state to its target.
        stretch: duration over the time that the policy meant, >= 1.
        trajectories: one Ruckig trajectory an arm.
    """

    duration_s: float
    stretch: float
    trajectories: tuple[Any, ...]

    def at(self, t: float) -> tuple[AxisMotion, ...]:
        """State of every arm `t` seconds after the start; at the end for later times."""
        t = min(max(t, 0.0), self.duration_s)
        states = []
        for trajectory in self.trajectories:
            p, v, a = trajectory.at_time(min(t, trajectory.duration))
            states.append(AxisMotion(tuple(p), tuple(v), tuple(a)))
        return tuple(states)

    def table(self, period_s: float) -> tuple[FloatArray, FloatArray]:
        """Positions and velocities after each control period, both (n, arms, axes)."""
        times = [(i + 1) * period_s for i in range(round(self.duration_s / period_s))]
        rows = [[tr.at_time(min(t, tr.duration)) for tr in self.trajectories] for t in times]
        samples = np.array(rows)  # (n, arms, 3, axes)
        return samples[:, :, 0], samples[:, :, 1]


def travel_time(
    limits: PlanLimits,
    start: AxisMotion,
    target: Sequence[float],
    end_velocity: Sequence[float],
    minimum_s: float,
) -> Any:
    """Ruckig trajectory of one arm that takes at least `minimum_s`.

    Raises:
        MotionError: Ruckig refuses the request.
    """
    start = _without_dust(start)
    request = _request(limits, start)
    request.target_position = [
        p if abs(goal - p) < DUST and v == 0.0 and a == 0.0 else goal
        for goal, p, v, a in zip(target, start.p, start.v, start.a, strict=True)
    ]
    request.target_velocity = [
        min(max(v, -limit), limit) for v, limit in zip(end_velocity, limits.velocity, strict=True)
    ]
    request.minimum_duration = minimum_s
    return _calculated(request)


def _without_dust(start: AxisMotion) -> AxisMotion:
    """The same state with rounding errors in speed and acceleration taken for the zeros they are.

    From a speed of 1e-12 and a stretched duration Ruckig may find a way that swings out by
    centimetres and comes back.
    """
    return AxisMotion(
        start.p,
        tuple(0.0 if abs(v) < DUST else v for v in start.v),
        tuple(0.0 if abs(a) < DUST / DUST_S else a for a in start.a),
    )


def is_direct(trajectory: Any, start: AxisMotion, target: Sequence[float]) -> bool:
    """Whether no axis swings out farther than the speeds at the ends explain."""
    duration = trajectory.duration
    _, v1, _ = trajectory.at_time(duration)
    for extrema, p, v, a, goal, w in zip(
        trajectory.position_extrema, start.p, start.v, start.a, target, v1, strict=True
    ):
        room = 0.5 * duration * (abs(v) + abs(w)) + 0.125 * duration**2 * abs(a) + SWING
        if extrema.min < min(p, goal) - room or extrema.max > max(p, goal) + room:
            return False
    return True


def _request(limits: PlanLimits, start: AxisMotion) -> Any:
    """Ruckig's input with limits and start filled in."""
    request = ruckig.InputParameter(len(start.p))
    request.current_position = list(start.p)
    request.current_velocity = list(start.v)
    request.current_acceleration = [
        min(max(a, -limit), limit) for a, limit in zip(start.a, limits.acceleration, strict=True)
    ]  # a rounding error above the limit makes Ruckig raise
    request.max_velocity = list(limits.velocity)
    request.max_acceleration = list(limits.acceleration)
    request.max_jerk = list(limits.jerk)
    return request


def _calculated(request: Any) -> Any:
    axes = request.degrees_of_freedom
    trajectory = ruckig.Trajectory(axes)
    try:
        ruckig.Ruckig(axes).calculate(request, trajectory)
    except (ruckig.RuckigError, ValueError) as error:
        raise MotionError(f"no jerk-limited motion: {error}") from error
    return trajectory


def passing_velocity(
    start: Sequence[AxisMotion], target: FloatArray, step_s: float
) -> list[list[float]]:
    """Axis velocities wished at a waypoint: displacement over step, jaw at rest; (axes,) an arm.

    Args:
        start: where the arms are.
        target: axis positions at the waypoint, (arms, axes).
        step_s: time that the step is meant to take, s.
    """
    rows = []
    for motion, goal in zip(start, target, strict=True):
        v = ((goal - np.array(motion.p)) / step_s).tolist()
        v[-1] = 0.0
        rows.append(v)
    return rows


def inside(limits: PlanLimits, trajectory: Any) -> bool:
    """Whether the whole trajectory keeps the position limits, which Ruckig ignores."""
    return all(
        low - 1e-9 <= extrema.min and extrema.max <= high + 1e-9
        for low, high, extrema in zip(
            limits.lower, limits.upper, trajectory.position_extrema, strict=True
        )
    )


def peaks(trajectory: Any) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Largest speed, acceleration and jerk of every axis on a trajectory, (axes,) each, exact."""
    rows = [
        (profile.t, profile.v, profile.a, profile.j)
        for section in trajectory.profiles
        for profile in section
    ]
    t, v, a, j = (np.array(column) for column in zip(*rows, strict=True))
    a0, j_or_1 = a[:, :-1], np.where(j == 0.0, 1.0, j)
    turn = np.where(j == 0.0, -1.0, -a0 / j_or_1)  # where in a phase the acceleration passes zero
    inner = np.where((turn > 0.0) & (turn < t), v[:, :-1] - 0.5 * a0**2 / j_or_1, 0.0)
    speed = np.maximum(np.abs(v).max(axis=1), np.abs(inner).max(axis=1))
    return speed, np.abs(a).max(axis=1), np.abs(np.where(t > 0.0, j, 0.0)).max(axis=1)


class SegmentPlanner:
    """Plans segments for one cell.

    Args:
        cell: the arms, their limits and the tip speed.
        period_s: control period; every segment is a whole number of them.
        speed: part of the planned tip speed to use, in (0, 1].
    """

    def __init__(self, cell: CellDescription, period_s: float, speed: float = 1.0) -> None:
        if not (0.0 < speed <= 1.0 and period_s > 0.0):
            raise MotionError("speed must be in (0, 1] and the control period positive")
        self.cell, self.period_s = cell, period_s
        self.limits = tuple(PlanLimits.of(arm.arm) for arm in cell.arms)
        self.tip_speed_m_s = PLAN_FRACTION * speed * cell.file.motion.tip_speed_m_s

    def plan(
        self,
        start: Sequence[AxisMotion],
        target: Sequence[Sequence[float]],
        end_velocity: Sequence[Sequence[float]],
        step_s: float,
    ) -> Segment:
        """The segment from `start` to `target`.

        Args:
            start: present state of every arm, as commanded.
            target: axis positions at the end, (axes,) an arm.
            end_velocity: axis velocities wished at the end, (axes,) an arm; lowered as the limits
                and the stretch demand.
            step_s: the time that the policy means it to take.

        Raises:
            MotionError: no motion inside the limits reaches the target.
        """
        duration, share = self._whole_periods(step_s), 1.0
        for attempt in range(ATTEMPTS):
            if attempt >= LAST_FAST_ATTEMPT:
                share = 0.0
            trajectories = tuple(
                travel_time(limits, s, goal, [share * x for x in v], duration)
                for limits, s, goal, v in zip(self.limits, start, target, end_velocity, strict=True)
            )
            longest = max(trajectory.duration for trajectory in trajectories)
            if longest > duration + 1e-9:
                share, duration = self._slower(share, longest / duration, duration)
                continue
            if not all(map(is_direct, trajectories, start, target)):
                share, duration = self._slower(share, 1.0, duration)
                continue
            if share > 0.0 and not all(map(inside, self.limits, trajectories)):
                share = 0.0
                continue
            segment = Segment(duration, duration / step_s, trajectories)
            excess = self.tip_speed(segment) / self.tip_speed_m_s
            if excess <= TIP_TOLERANCE:
                return self._checked(segment)
            share, duration = self._slower(share, min(excess, 3.0), duration)
        raise MotionError(
            "no motion inside speed, acceleration and jerk limits reaches the waypoint; "
            "ask for a smaller step"
        )

    def brake(self, start: Sequence[AxisMotion]) -> Segment:
        """The quickest jerk-limited way from a moving state to rest, wherever that is."""
        trajectories = []
        for limits, state in zip(self.limits, start, strict=True):
            request = _request(limits, state)
            request.control_interface = ruckig.ControlInterface.Velocity
            request.target_velocity = [0.0] * len(state.p)
            trajectories.append(_calculated(request))
        duration = self._whole_periods(max(t.duration for t in trajectories))
        return Segment(duration, 1.0, tuple(trajectories))

    def tip_speed(self, segment: Segment) -> float:
        """Largest mean tip speed of any arm over a sixteenth of the segment, m/s."""
        piece_s = segment.duration_s / TIP_SAMPLES
        motions = [segment.at(i * piece_s) for i in range(TIP_SAMPLES + 1)]
        fastest = 0.0
        for index, arm in enumerate(self.cell.arms):
            q = np.array([motion[index].p[:-1] for motion in motions])
            steps = np.diff(forward_batch(arm.arm, q)[:, :3, 3], axis=0)
            fastest = max(fastest, float(np.sqrt((steps**2).sum(axis=1).max())))
        return fastest / piece_s

    def _checked(self, segment: Segment) -> Segment:
        if all(map(inside, self.limits, segment.trajectories)):
            return segment
        raise MotionError("the motion to the waypoint leaves a joint limit; ask for a smaller step")

    def _slower(self, share: float, factor: float, duration: float) -> tuple[float, float]:
        longer = self._whole_periods(max(duration * factor, duration + self.period_s))
        return share * duration / longer, longer

    def _whole_periods(self, seconds: float) -> float:
        return math.ceil(seconds / self.period_s - 1e-6) * self.period_s
