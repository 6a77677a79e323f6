"""`SegmentPlanner` for many cells side by side: the same decisions, arrays instead of values.

Ruckig calculates one arm of one environment after the other; its profiles are read as cubic
polynomials in pieces, and everything else happens for all environments at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import ruckig

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import FloatArray
from viskill_deploy.kinematics.model import tip_positions
from viskill_deploy.motion.limits import PlanLimits
from viskill_deploy.motion.smoothing import (
    ATTEMPTS,
    AXES,
    DUST,
    DUST_S,
    LAST_FAST_ATTEMPT,
    SWING,
    TIP_SAMPLES,
    TIP_TOLERANCE,
    SegmentPlanner,
)

BoolArray = npt.NDArray[np.bool_]
PHASES = 9
"""Two phases of braking into the limits and seven of the profile, each of constant jerk."""


@dataclass(frozen=True, slots=True)
class Motions:
    """Commanded states: positions, velocities, accelerations, (N, arms, 7) each; rad or m, s."""

    p: FloatArray
    v: FloatArray
    a: FloatArray

    def rows(self, index: BoolArray | npt.NDArray[np.intp]) -> Motions:
        """The states of some environments."""
        return Motions(self.p[index], self.v[index], self.a[index])

    @classmethod
    def at_rest(cls, p: FloatArray) -> Motions:
        """No motion at `p`."""
        return cls(p, np.zeros_like(p), np.zeros_like(p))


@dataclass(frozen=True, slots=True)
class Paths:
    """Trajectories in pieces of constant jerk; arrays start with (N, arms, 7).

    Attributes:
        start: states at time zero.
        jerk: jerk of every phase, (..., 9).
        time: length of every phase, (..., 9), s.
        duration: of each arm's trajectory, (N, arms), s.
        low: lowest position, (N, arms, 7).
        high: highest position, (N, arms, 7).
    """

    start: Motions
    jerk: FloatArray
    time: FloatArray
    duration: FloatArray
    low: FloatArray
    high: FloatArray

    def rows(self, index: BoolArray | npt.NDArray[np.intp]) -> Paths:
        """The paths of some environments."""
        return Paths(
            self.start.rows(index),
            self.jerk[index],
            self.time[index],
            self.duration[index],
            self.low[index],
            self.high[index],
        )

    def end(self) -> Motions:
        """States at the end of the last phase."""
        p, v, a = self.start.p, self.start.v, self.start.a
        for phase in range(PHASES):
            t, j = self.time[..., phase], self.jerk[..., phase]
            p = p + t * (v + t * (a / 2 + t * j / 6))
            v = v + t * (a + t * j / 2)
            a = a + t * j
        return Motions(p, v, a)

    def positions(self, times: FloatArray) -> FloatArray:
        """Positions at times (N, n) within the motion, (N, arms, 7, n)."""
        return self._sampled(times, False)[0]

    def sampled(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions and velocities at times (N, n) within the motion, (N, arms, 7, n) each."""
        return self._sampled(times, True)

    def _sampled(self, times: FloatArray, speeds: bool) -> tuple[FloatArray, FloatArray]:
        """Each change of jerk adds a cube from its moment on (a spline in truncated powers)."""
        t = times[:, None, None, :]
        p0, v0, a0 = (x[..., None] for x in (self.start.p, self.start.v, self.start.a))
        half = a0 / 2
        p = p0 + t * (v0 + t * half)
        v = v0 + t * a0 if speeds else p
        knots = np.cumsum(self.time, axis=-1) - self.time
        change = np.diff(self.jerk, axis=-1, prepend=0.0)
        for phase in range(PHASES):
            if not change[..., phase].any():
                continue
            since = np.maximum(t - knots[..., phase, None], 0.0)
            square = since * since
            square *= change[..., phase, None] / 2
            if speeds:
                v += square
            square *= since
            square /= 3.0
            p += square
        return p, v


@dataclass(frozen=True, slots=True)
class Segments:
    """A motion of all arms in every environment.

    Attributes:
        paths: the trajectories; those of environments that are not `planned` mean nothing.
        periods: length in control periods, (N,).
        stretch: duration over the time that the policy meant, (N,).
        planned: whether there is a motion inside the limits, (N,).
    """

    paths: Paths
    periods: npt.NDArray[np.intp]
    stretch: FloatArray
    planned: BoolArray


class VectorPlanner:
    """Plans segments for many cells; see `SegmentPlanner`.

    Args:
        cell: the arms, their limits and the tip speed.
        period_s: control period; every segment is a whole number of them.
    """

    def __init__(self, cell: CellDescription, period_s: float) -> None:
        self.cell, self.period_s = cell, period_s
        planner = SegmentPlanner(cell, period_s)
        self._tip_speed_m_s = planner.tip_speed_m_s
        self._ruckigs = [_ArmRuckig(limits) for limits in planner.limits]
        self._lower = np.array([limits.lower for limits in planner.limits])
        self._upper = np.array([limits.upper for limits in planner.limits])
        self._fastest = np.array([limits.velocity for limits in planner.limits])
        self._quickest = np.array([limits.acceleration for limits in planner.limits])

    def plan(
        self, start: Motions, target: FloatArray, end_velocity: FloatArray, step_s: float
    ) -> Segments:
        """The segments from `start` to `target`.

        Args:
            start: present states, as commanded.
            target: axis positions at the end, (N, arms, 7).
            end_velocity: axis velocities wished at the end, (N, arms, 7); lowered as the limits and
                the stretch demand.
            step_s: the time that the policy means a step to take.
        """
        count = len(target)
        start, target = self._clean(start, target)
        duration = self._whole_periods(np.full(count, step_s))
        share, todo = np.ones(count), np.arange(count)
        planned = np.zeros(count, dtype=bool)
        paths = _empty(start)
        for attempt in range(ATTEMPTS):
            if not len(todo):
                break
            if attempt >= LAST_FAST_ATTEMPT:
                share[todo] = 0.0
            now, goal = start.rows(todo), target[todo]
            wish = share[todo, None, None] * end_velocity[todo]
            tried, sound = self._calculated(now, goal, wish, duration[todo])
            verdict = self._judged(tried, sound, goal, share[todo], duration[todo])
            done = verdict.accepted | verdict.refused
            _put(paths, todo[done], tried, done)
            planned[todo[verdict.accepted]] = True
            share[todo[verdict.outside]] = 0.0
            slow = todo[verdict.slower]
            share[slow], duration[slow] = self._slower(
                share[slow], verdict.factor[verdict.slower], duration[slow]
            )
            todo = todo[~done]
        periods = np.rint(duration / self.period_s).astype(np.intp)
        return Segments(paths, periods, duration / step_s, planned)

    def _clean(self, start: Motions, target: FloatArray) -> tuple[Motions, FloatArray]:
        """Start without rounding errors, and targets that are not a rounding error away."""
        v = np.where(np.abs(start.v) < DUST, 0.0, start.v)
        a = np.where(np.abs(start.a) < DUST / DUST_S, 0.0, start.a)
        stays = (np.abs(target - start.p) < DUST) & (v == 0.0) & (a == 0.0)
        a = np.clip(a, -self._quickest, self._quickest)
        return Motions(start.p, v, a), np.where(stays, start.p, target)

    def _calculated(
        self, start: Motions, target: FloatArray, wish: FloatArray, duration: FloatArray
    ) -> tuple[Paths, BoolArray]:
        """Ruckig's paths, and where it gave any, (N,)."""
        wish = np.clip(wish, -self._fastest, self._fastest)
        paths = _empty(start)
        sound = np.ones(len(target), dtype=bool)
        lists = [x.tolist() for x in (start.p, start.v, start.a, target, wish)]
        for env, (seconds, *rows) in enumerate(zip(duration.tolist(), *lists, strict=True)):
            for arm, (solver, *state) in enumerate(zip(self._ruckigs, *rows, strict=True)):
                if solver.calculate(*state, seconds):
                    solver.read(paths, env, arm)
                else:
                    sound[env] = False
        return paths, sound

    def _judged(
        self,
        paths: Paths,
        sound: BoolArray,
        target: FloatArray,
        share: FloatArray,
        duration: FloatArray,
    ) -> _Verdict:
        longest = paths.duration.max(axis=-1)
        late = sound & (longest > duration + 1e-9)
        direct = self._are_direct(paths, target)
        crooked = sound & ~late & ~direct
        inside = (paths.low >= self._lower - 1e-9) & (paths.high <= self._upper + 1e-9)
        kept = inside.all(axis=(1, 2))
        outside = sound & ~late & ~crooked & (share > 0.0) & ~kept
        open_ = sound & ~late & ~crooked & ~outside
        excess = np.ones(len(target))
        if open_.any():
            excess = self._tip_speed(paths, duration) / self._tip_speed_m_s
        fast = open_ & ~(excess <= TIP_TOLERANCE)
        factor = np.where(late, longest / duration, 1.0)
        factor = np.where(fast, np.minimum(excess, 3.0), factor)
        ends = open_ & ~fast
        slower = late | crooked | fast
        return _Verdict(ends & kept, ~sound | (ends & ~kept), slower, outside, factor)

    def _are_direct(self, paths: Paths, target: FloatArray) -> BoolArray:
        """Whether no axis swings out farther than the speeds at the ends explain, (N,)."""
        start, duration = paths.start, paths.duration[..., None]
        speeds = np.abs(start.v) + np.abs(paths.end().v)
        room = 0.5 * duration * speeds + 0.125 * duration**2 * np.abs(start.a) + SWING
        low, high = np.minimum(start.p, target) - room, np.maximum(start.p, target) + room
        direct: BoolArray = ((paths.low >= low) & (paths.high <= high)).all(axis=(1, 2))
        return direct

    def _tip_speed(self, paths: Paths, duration: FloatArray) -> FloatArray:
        """Largest mean tip speed of any arm over a sixteenth of the segment, (N,) m/s."""
        piece = duration / TIP_SAMPLES
        times = np.minimum(np.arange(TIP_SAMPLES + 1) * piece[:, None], duration[:, None])
        q = paths.positions(times)
        fastest = np.zeros(len(duration))
        for index, arm in enumerate(self.cell.arms):
            tips = tip_positions(arm.arm, np.moveaxis(q[:, index, :6], 1, -1))
            steps = np.diff(tips, axis=1)
            fastest = np.maximum(fastest, np.sqrt((steps**2).sum(axis=-1).max(axis=-1)))
        return fastest / piece

    def _slower(
        self, share: FloatArray, factor: FloatArray, duration: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        longer = self._whole_periods(np.maximum(duration * factor, duration + self.period_s))
        return share * duration / longer, longer

    def _whole_periods(self, seconds: FloatArray) -> FloatArray:
        whole: FloatArray = np.ceil(seconds / self.period_s - 1e-6) * self.period_s
        return whole


@dataclass(frozen=True, slots=True)
class _Verdict:
    """What becomes of an attempt, (n,) each; `factor` is for those that shall be slower."""

    accepted: BoolArray
    refused: BoolArray
    slower: BoolArray
    outside: BoolArray
    factor: FloatArray


class _ArmRuckig:
    """Ruckig for one arm, its objects kept from call to call."""

    def __init__(self, limits: PlanLimits) -> None:
        self._request = ruckig.InputParameter(AXES)
        self._request.max_velocity = list(limits.velocity)
        self._request.max_acceleration = list(limits.acceleration)
        self._request.max_jerk = list(limits.jerk)
        self._ruckig, self._trajectory = ruckig.Ruckig(AXES), ruckig.Trajectory(AXES)

    def calculate(
        self,
        p: list[float],
        v: list[float],
        a: list[float],
        target: list[float],
        wish: list[float],
        minimum_s: float,
    ) -> bool:
        """Whether there is a jerk-limited motion."""
        request = self._request
        request.current_position, request.current_velocity = p, v
        request.current_acceleration = a
        request.target_position, request.target_velocity = target, wish
        request.minimum_duration = minimum_s
        try:
            self._ruckig.calculate(request, self._trajectory)
        except (ruckig.RuckigError, ValueError):
            return False
        return True

    def read(self, paths: Paths, env: int, arm: int) -> None:
        """Writes the last motion to its place in `paths`."""
        trajectory: Any = self._trajectory
        profiles = trajectory.profiles[0]
        paths.duration[env, arm] = duration = trajectory.duration
        time = [profile.t for profile in profiles]
        paths.time[env, arm, :, 2:] = time
        paths.jerk[env, arm, :, 2:] = [profile.j for profile in profiles]
        for axis, phases in enumerate(time):
            if abs(math.fsum(phases) - duration) > 1e-9:
                brake = profiles[axis].brake
                paths.time[env, arm, axis, :2] = brake.t
                paths.jerk[env, arm, axis, :2] = brake.j
        extrema = [(e.min, e.max) for e in trajectory.position_extrema]
        paths.low[env, arm], paths.high[env, arm] = zip(*extrema, strict=True)


def _empty(start: Motions) -> Paths:
    """Paths that stand still at `start`."""
    shape = (*start.p.shape, PHASES)
    still = np.zeros(start.p.shape[:2])
    return Paths(start, np.zeros(shape), np.zeros(shape), still, start.p.copy(), start.p.copy())


def _put(paths: Paths, places: npt.NDArray[np.intp], source: Paths, rows: BoolArray) -> None:
    """Copies rows of `source` to places in `paths`; both have the same start states."""
    for name in ("jerk", "time", "duration", "low", "high"):
        getattr(paths, name)[places] = getattr(source, name)[rows]
