"""Jerk-limited trajectories of many arms at once, as cubic polynomials in pieces.

Array axes: piece or moment first, then environment, arm, axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.types import FloatArray

Rows = npt.NDArray[np.intp] | npt.NDArray[np.bool_]
PHASES = 9
"""Two phases of braking into the limits and the seven of Ruckig's profile."""


@dataclass(frozen=True, slots=True)
class Motions:
    """Commanded states: positions, velocities, accelerations, (N, arms, 7) each; rad or m, s."""

    p: FloatArray
    v: FloatArray
    a: FloatArray

    def rows(self, index: Rows) -> Motions:
        """The states of some environments."""
        return Motions(self.p[index], self.v[index], self.a[index])

    @classmethod
    def at_rest(cls, p: FloatArray) -> Motions:
        """No motion at `p`."""
        return cls(p, np.zeros_like(p), np.zeros_like(p))


@dataclass(frozen=True, slots=True)
class Paths:
    """Trajectories in phases of constant jerk.

    Attributes:
        time: when each phase begins, and when the last one ends, (10, N, arms, 7), s.
        p: positions at these times.
        v: velocities at these times.
        a: accelerations at these times.
        jerk: jerk in each phase, (9, N, arms, 7).
    """

    time: FloatArray
    p: FloatArray
    v: FloatArray
    a: FloatArray
    jerk: FloatArray

    @classmethod
    def integrated(cls, start: Motions, lengths: FloatArray, jerk: FloatArray) -> Paths:
        """The paths from `start` with phases of these lengths, (9, N, arms, 7) s, and jerks."""
        p, v, a = (np.empty((PHASES + 1, *start.p.shape)) for _ in range(3))
        p[0], v[0], a[0] = start.p, start.v, start.a
        for k in range(PHASES):
            t, j = lengths[k], jerk[k]
            p[k + 1] = p[k] + t * (v[k] + t * (a[k] / 2 + t * j / 6))
            v[k + 1] = v[k] + t * (a[k] + t * j / 2)
            a[k + 1] = a[k] + t * j
        time = np.zeros_like(p)
        np.cumsum(lengths, axis=0, out=time[1:])
        return cls(time, p, v, a, jerk)

    @classmethod
    def joined(cls, parts: Sequence[Paths]) -> Paths:
        """The environments of all parts, one part after the other."""
        names = ("time", "p", "v", "a", "jerk")
        return cls(*(np.concatenate([getattr(x, name) for x in parts], axis=1) for name in names))

    def rows(self, index: Rows) -> Paths:
        """The paths of some environments."""
        return Paths(*(x[:, index] for x in (self.time, self.p, self.v, self.a, self.jerk)))

    def end(self) -> Motions:
        """States at the end of the last phase."""
        return Motions(self.p[-1], self.v[-1], self.a[-1])

    def sampled(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Positions and velocities at times (n,) or (n, N) within the motion, (n, N, arms, 7)."""
        since, p, v, a, j = self._at(times)
        slope = since * j
        return p + since * (v + since * (a / 2 + slope / 6)), v + since * (a + slope / 2)

    def positions(self, times: FloatArray) -> FloatArray:
        """Positions at times (n,) or (n, N) within the motion, (n, N, arms, 7)."""
        since, p, v, a, j = self._at(times)
        return p + since * (v + since * (a / 2 + since * j / 6))

    def _at(self, times: FloatArray) -> tuple[FloatArray, ...]:
        """Time since the start of the phase at each moment, and that phase's p, v, a and jerk."""
        t = times.reshape(len(times), -1, 1, 1)
        number = np.zeros((len(times), *self.p.shape[1:]), dtype=np.int8)
        for begin in self.time[1:-1]:
            number += (t >= begin).view(np.int8)
        size = self.p[0].size
        place = number * np.intp(size) + np.arange(size).reshape(self.p.shape[1:])
        start, *state = (x.reshape(-1).take(place) for x in (self.time, self.p, self.v, self.a))
        return t - start, *state, self.jerk.reshape(-1).take(place)
