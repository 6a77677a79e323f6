"""Whether numbers may be used at all. Comparisons let a NaN pass, so this comes before them."""

from __future__ import annotations

from math import isfinite
from typing import Any

_SIX = (float,) * 6


def is_sound_vector(values: Any) -> bool:
    """True for a tuple of six finite floats (float64; numpy's float64 scalar is one).

    A tuple, because a list could still change after the gate has looked at it. A sum that
    overflows counts as not finite.
    """
    return (
        values.__class__ is tuple
        and len(values) == 6
        and (tuple(map(type, values)) == _SIX or all(isinstance(x, float) for x in values))
        and isfinite(sum(values))
    )


def is_sound_number(value: object) -> bool:
    """True for one finite float."""
    return isinstance(value, float) and isfinite(value)


def first_unsound(values: Any) -> int:
    """Index of the first entry that is not a finite float; -1 when the shape is wrong."""
    if isinstance(values, tuple) and len(values) == 6:
        for index, value in enumerate(values):
            if not is_sound_number(value):
                return index
    return -1
