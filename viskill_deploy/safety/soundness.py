"""Whether numbers may be used at all. Comparisons let a NaN pass, so this comes before them."""

from __future__ import annotations

from math import isfinite
from typing import Any


def is_vector(values: Any, count: int) -> bool:
    """True for a tuple of `count` things: a list could still change after the gate has looked."""
    return values.__class__ is tuple and len(values) == count


def are_sound(values: tuple[Any, ...]) -> bool:
    """True if all are finite floats (float64; numpy's float64 scalar is one).

    Numbers so large that their sum overflows count as not finite.
    """
    return all(map(_is_float_type, set(map(type, values)))) and isfinite(sum(values))


def _is_float_type(kind: type) -> bool:
    return issubclass(kind, float)


def first_unsound(values: tuple[Any, ...]) -> int:
    """Index of the first entry that is not a finite float; the length when all are."""
    for index, value in enumerate(values):
        if not (isinstance(value, float) and isfinite(value)):
            return index
    return len(values)
