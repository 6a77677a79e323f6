"""Who sees the tips: the simulator as a tracker with all that trackers do wrong."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.world import World


@dataclass(frozen=True, slots=True)
class TrackerOptions:
    """What is wrong with a tracker.

    Attributes:
        noise_m: standard deviation of a coordinate.
        outlier_share: part of the points that are wrong by centimetres.
        outlier_m: standard deviation of a coordinate of those.
        delay_s: how old a point is when it gets its stamp, for each arm.
        point_m: how far beyond the jaw pivot, along the tip, what it sees is.
    """

    noise_m: float = 0.0002
    outlier_share: float = 0.05
    outlier_m: float = 0.02
    delay_s: tuple[float, ...] = ()
    point_m: float = 0.0


class SimulatedTracker:
    """Sees the true tips of a world.

    Args:
        world: the world.
        options: what is wrong with it.
        seed: of noise and outliers.

    Attributes:
        point_m: see `TrackerOptions`.
    """

    def __init__(self, world: World, options: TrackerOptions, seed: int = 0) -> None:
        self._world, self._options, self.point_m = world, options, options.point_m
        self._rng = np.random.default_rng([seed, 7])
        self._names = [arm.name for arm in world.cell.arms]
        delays = options.delay_s or (0.0,) * len(self._names)
        self._delays = dict(zip(self._names, delays, strict=True))
        self._past: deque[tuple[float, FloatArray]] = deque(maxlen=200)

    def look(self, now: float) -> None:
        """Remembers where the tips are now; call it in every control period."""
        self._past.append((now, self._world.tips(self.point_m)))

    def points(self, now: float) -> dict[str, tuple[float, FloatArray]]:
        """What it says now, and the stamp that it puts on it: now, however old it is; m."""
        options, seen = self._options, {}
        for index, name in enumerate(self._names):
            point = self._at(index, now - self._delays[name])
            is_wrong = self._rng.random() < options.outlier_share
            spread = options.outlier_m if is_wrong else options.noise_m
            seen[name] = (now, point + self._rng.normal(0.0, spread, 3))
        return seen

    def _at(self, arm: int, time: float) -> FloatArray:
        times = np.array([t for t, _ in self._past])
        tips = np.array([tips[arm] for _, tips in self._past])
        return np.array([np.interp(time, times, tips[:, axis]) for axis in range(3)])
