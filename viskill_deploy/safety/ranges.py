"""Lower and upper bounds of several numbers, ready for a fast look."""

from __future__ import annotations

from collections.abc import Sequence
from operator import mul, sub

from viskill_deploy.core.types import Joints
from viskill_deploy.safety.envelope import ROUNDING


class Ranges:
    """Closed ranges, each widened by a rounding's width."""

    __slots__ = ("_half", "_inverse", "_middle")

    def __init__(self, lower: Sequence[float], upper: Sequence[float]) -> None:
        pairs = list(zip(lower, upper, strict=True))
        self._middle = [0.5 * (low + high) for low, high in pairs]
        self._half = [0.5 * (high - low) * (1.0 + ROUNDING) for low, high in pairs]
        self._inverse = [1.0 / half for half in self._half]

    def farthest(self, values: Joints) -> float:
        """Largest distance from the middle as a part of half the range; above 1.0 is outside."""
        return max(self.parts(values))

    def parts(self, values: Joints) -> list[float]:
        """The same for each number; values beyond the number of ranges are not looked at."""
        return list(map(mul, map(abs, map(sub, values, self._middle)), self._inverse))

    def is_below(self, index: int, value: float) -> bool:
        """Under the lower bound."""
        return (self._middle[index] - value) * self._inverse[index] > 1.0

    def is_above(self, index: int, value: float) -> bool:
        """Over the upper bound."""
        return (value - self._middle[index]) * self._inverse[index] > 1.0

    def nearest(self, index: int, value: float) -> float:
        """The bound that is nearer to a value."""
        side = 1.0 if value >= self._middle[index] else -1.0
        return self._middle[index] + side * self._half[index]
