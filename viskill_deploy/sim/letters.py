"""The nine characters of the match board, as strokes of boxes, and where a jaw takes them.

A character is drawn on a grid of u (to the reader's right) and v (up), both from -1 to 1 at the
middle of its outer strokes. It lies with v along -x and u along +y of its body: it reads upright
for someone who looks from the far side of the table towards the arm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from viskill_deploy.core.cell_files import Letter
from viskill_deploy.core.types import FloatArray

PREFIX = "letter"


@dataclass(frozen=True, slots=True)
class Shape:
    """One character.

    Attributes:
        strokes: bars from (u, v) to (u, v), along u or along v.
        feet: points (u, v) on which it stands.
        grasp: the point (u, v) of an upright stroke where a jaw has room on both sides.
    """

    strokes: tuple[tuple[float, float, float, float], ...]
    feet: tuple[tuple[float, float], ...]
    grasp: tuple[float, float]


_TOP, _MIDDLE, _BOTTOM = (-1, 1, 1, 1), (-1, 0, 1, 0), (-1, -1, 1, -1)
_LEFT, _LEFT_UP, _LEFT_DOWN = (-1, -1, -1, 1), (-1, 0, -1, 1), (-1, -1, -1, 0)
_RIGHT, _RIGHT_UP, _RIGHT_DOWN = (1, -1, 1, 1), (1, 0, 1, 1), (1, -1, 1, 0)
_CORNERS = ((-1, -1), (-1, 1), (1, -1), (1, 1))

SHAPES = {
    "0": Shape((_LEFT, _RIGHT, _TOP, _BOTTOM), _CORNERS, (-1, 0)),
    "1": Shape(((0, -1, 0, 1), (-0.6, 1, 0, 1), _BOTTOM), ((-1, -1), (1, -1), (0, 1)), (0, 0)),
    "2": Shape((_TOP, _RIGHT_UP, _MIDDLE, _LEFT_DOWN, _BOTTOM), _CORNERS, (-1, -0.5)),
    "4": Shape((_LEFT_UP, _MIDDLE, _RIGHT), ((-1, 1), (-1, 0), (1, 1), (1, -1)), (1, 0.5)),
    "5": Shape((_TOP, _LEFT_UP, _MIDDLE, _RIGHT_DOWN, _BOTTOM), _CORNERS, (-1, 0.5)),
    "6": Shape((_TOP, _LEFT, _MIDDLE, _RIGHT_DOWN, _BOTTOM), _CORNERS, (-1, 0.5)),
    "A": Shape((_LEFT, _RIGHT, _TOP, _MIDDLE), _CORNERS, (-1, -0.5)),
    "B": Shape(
        (_LEFT, (-1, 1, 0.6, 1), (0.6, 0, 0.6, 1), _MIDDLE, _RIGHT_DOWN, _BOTTOM),
        ((-1, -1), (-1, 1), (1, -1), (0.6, 1)),
        (-1, 0.5),
    ),
    "C": Shape((_LEFT, _TOP, _BOTTOM), _CORNERS, (-1, 0)),
}
"""By what they show. `0 1 2 4 5 6 A B C` are the characters of the reference."""

NAMES = tuple(PREFIX + shown for shown in SHAPES)
"""Names of the bodies."""

GRASP_YAW_RAD = math.pi / 2
"""Yaw of every grasp frame in its letter: the jaw closes along y."""


def shape_of(name: str) -> Shape:
    """The shape of the body called `name`."""
    return SHAPES[name.removeprefix(PREFIX)]


def plane_point(letter: Letter, u: float, v: float) -> FloatArray:
    """The point (u, v) in the frame of the letter's body, whose origin is its middle; (3,) m."""
    x, y, _ = letter.size_m
    return np.array([-v * (x - letter.stroke_m) / 2, u * (y - letter.stroke_m) / 2, 0.0])


def grasp_point(letter: Letter, name: str) -> FloatArray:
    """Where a jaw takes the letter called `name`, in its frame; (3,) m."""
    return plane_point(letter, *shape_of(name).grasp)
