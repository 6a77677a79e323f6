"""How well stated probabilities agree with what happened."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.types import FloatArray

BINS = 10
GROUPS = {"low": (0.0, 1 / 3), "middle": (1 / 3, 2 / 3), "high": (2 / 3, 1.0)}


@dataclass(frozen=True, slots=True)
class Bin:
    """Episodes whose stated probability lies in a stretch of [0, 1].

    Attributes:
        lower, upper: of the stretch.
        count: episodes in it.
        value: their mean stated probability, None without episodes.
        success: the part of them that succeeded, None without episodes.
    """

    lower: float
    upper: float
    count: int
    value: float | None
    success: float | None


@dataclass(frozen=True, slots=True)
class Reliability:
    """Stated probabilities against outcomes.

    Attributes:
        episodes: how many.
        error: expected calibration error: mean |value - success| of ten bins of equal width,
            weighted by their episodes; None without episodes.
        bins: the ten.
        groups: the thirds of [0, 1]: low, middle and high.
    """

    episodes: int
    error: float | None
    bins: tuple[Bin, ...]
    groups: dict[str, Bin]


def reliability(values: FloatArray, outcomes: npt.NDArray[np.bool_]) -> Reliability:
    """Compares stated probabilities (N,) in [0, 1] with outcomes (N,)."""
    edges = [index / BINS for index in range(BINS + 1)]
    bins = tuple(_bin(values, outcomes, *stretch) for stretch in pairwise(edges))
    groups = {name: _bin(values, outcomes, *stretch) for name, stretch in GROUPS.items()}
    return Reliability(len(values), calibration_error(bins), bins, groups)


def calibration_error(bins: Iterable[Bin]) -> float | None:
    """Mean |value - success|, weighted by episodes; None without any."""
    gaps = [
        (b.count, abs(b.value - b.success))
        for b in bins
        if b.value is not None and b.success is not None
    ]
    count = sum(n for n, _ in gaps)
    return sum(n * gap for n, gap in gaps) / count if count else None


def pooled(parts: Sequence[Reliability]) -> Reliability:
    """Several comparisons as one, as if their episodes had been compared together."""
    bins = tuple(_joined(same) for same in zip(*(part.bins for part in parts), strict=True))
    groups = {name: _joined([part.groups[name] for part in parts]) for name in GROUPS}
    return Reliability(sum(part.episodes for part in parts), calibration_error(bins), bins, groups)


def _bin(values: FloatArray, outcomes: npt.NDArray[np.bool_], lower: float, upper: float) -> Bin:
    """The stretch [lower, upper), and 1 belongs to the last one."""
    inside = (values >= lower) & ((values < upper) | (upper == 1.0))
    count = int(inside.sum())
    if not count:
        return Bin(lower, upper, 0, None, None)
    mean, success = float(values[inside].mean()), float(outcomes[inside].mean())
    return Bin(lower, upper, count, mean, success)


def _joined(bins: Sequence[Bin]) -> Bin:
    count = sum(b.count for b in bins)

    def mean(name: str) -> float | None:
        parts = [b.count * getattr(b, name) for b in bins if b.count]
        return sum(parts) / count if count else None

    return Bin(bins[0].lower, bins[0].upper, count, mean("value"), mean("success"))
