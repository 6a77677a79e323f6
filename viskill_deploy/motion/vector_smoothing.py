"""`SegmentPlanner` for many cells side by side: the same decisions, arrays instead of values.

Ruckig calculates one arm of one environment after the other; everything else happens for all
environments at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import FloatArray
from viskill_deploy.kinematics.model import tip_positions
from viskill_deploy.motion.smoothing import (
    ATTEMPTS,
    DUST,
    DUST_S,
    LAST_FAST_ATTEMPT,
    SWING,
    TIP_SAMPLES,
    TIP_TOLERANCE,
    SegmentPlanner,
)
from viskill_deploy.motion.vector_paths import Motions, Paths
from viskill_deploy.motion.vector_ruckig import Answers, Ruckigs

BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.intp]


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
    periods: IntArray
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
        self._ruckigs = Ruckigs(planner.limits)
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
        start, goal = self._clean(start, target)
        duration = self._whole_periods(np.full(count, step_s))
        share, todo = np.ones(count), np.arange(count)
        planned = np.zeros(count, dtype=bool)
        parts: list[Paths] = []
        order: list[IntArray] = []
        for attempt in range(ATTEMPTS):
            if attempt >= LAST_FAST_ATTEMPT:
                share[todo] = 0.0
            wish = np.clip(
                share[todo, None, None] * end_velocity[todo], -self._fastest, self._fastest
            )
            tried = self._ruckigs.calculate(start.rows(todo), goal[todo], wish, duration[todo])
            verdict = self._judged(tried, target[todo], share[todo], duration[todo])
            done = ~(verdict.slower | verdict.outside)
            if attempt == ATTEMPTS - 1:
                done[:] = True
            parts.append(tried.paths.rows(done))
            order.append(todo[done])
            planned[todo[verdict.accepted]] = True
            share[todo[verdict.outside]] = 0.0
            slow = todo[verdict.slower]
            share[slow], duration[slow] = self._slower(
                share[slow], verdict.factor[verdict.slower], duration[slow]
            )
            todo = todo[~done]
            if not len(todo):
                break
        paths = Paths.joined(parts).rows(np.argsort(np.concatenate(order)))
        periods = np.rint(duration / self.period_s).astype(np.intp)
        return Segments(paths, periods, duration / step_s, planned)

    def _clean(self, start: Motions, target: FloatArray) -> tuple[Motions, FloatArray]:
        """Start without rounding errors, and targets that are not a rounding error away."""
        v = np.where(np.abs(start.v) < DUST, 0.0, start.v)
        a = np.where(np.abs(start.a) < DUST / DUST_S, 0.0, start.a)
        stays = (np.abs(target - start.p) < DUST) & (v == 0.0) & (a == 0.0)
        a = np.clip(a, -self._quickest, self._quickest)
        return Motions(start.p, v, a), np.where(stays, start.p, target)

    def _judged(
        self, tried: Answers, target: FloatArray, share: FloatArray, duration: FloatArray
    ) -> _Verdict:
        """What `SegmentPlanner.plan` would say to an attempt."""
        longest = tried.duration.max(axis=-1)
        sound = ~np.isnan(longest)
        late = sound & (longest > duration + 1e-9)
        crooked = sound & ~late & ~_are_direct(tried, target)
        inside = (tried.low >= self._lower - 1e-9) & (tried.high <= self._upper + 1e-9)
        kept = inside.all(axis=(1, 2))
        outside = sound & ~late & ~crooked & (share > 0.0) & ~kept
        open_ = sound & ~late & ~crooked & ~outside
        excess = self._tip_speed(tried.paths, duration) / self._tip_speed_m_s
        fast = open_ & ~(excess <= TIP_TOLERANCE)
        factor = np.where(late, longest / duration, 1.0)
        factor = np.where(fast, np.minimum(excess, 3.0), factor)
        return _Verdict(open_ & ~fast & kept, late | crooked | fast, outside, factor)

    def _tip_speed(self, paths: Paths, duration: FloatArray) -> FloatArray:
        """Largest mean tip speed of any arm over a sixteenth of the segment, (N,) m/s."""
        piece = duration / TIP_SAMPLES
        q = paths.positions(np.arange(TIP_SAMPLES + 1)[:, None] * piece)
        fastest = np.zeros(len(duration))
        for index, arm in enumerate(self.cell.arms):
            steps = np.diff(tip_positions(arm.arm, q[:, :, index, :6]), axis=0)
            fastest = np.maximum(fastest, (steps**2).sum(axis=-1).max(axis=0))
        speed: FloatArray = np.sqrt(fastest) / piece
        return speed

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
    slower: BoolArray
    outside: BoolArray
    factor: FloatArray


def _are_direct(tried: Answers, target: FloatArray) -> BoolArray:
    """Whether no axis swings out farther than the speeds at the ends explain, (N,)."""
    p, v, a = (x[0] for x in (tried.paths.p, tried.paths.v, tried.paths.a))
    duration, speeds = tried.duration[..., None], np.abs(v) + np.abs(tried.paths.v[-1])
    room = 0.5 * duration * speeds + 0.125 * duration**2 * np.abs(a) + SWING
    lowest, highest = np.minimum(p, target) - room, np.maximum(p, target) + room
    direct: BoolArray = ((tried.low >= lowest) & (tried.high <= highest)).all(axis=(1, 2))
    return direct
