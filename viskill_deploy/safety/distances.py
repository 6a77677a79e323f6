"""Distances between line segments and boxes, in plain floats."""

from __future__ import annotations

from math import dist, sqrt

from viskill_deploy.safety.geometry import Point

LEAST = 1e-300
"""Instead of a division by zero, where any result in [0, 1] will do: on a segment that is a point,
between segments that are parallel."""


def between_segments(a: Point, b: Point, c: Point, d: Point) -> float:
    """Distance between the segments a-b and c-d, m.

    The closest points of the two lines, each moved into its segment in turn (Ericson, Real-Time
    Collision Detection, 2005, 5.1.9).
    """
    ax, ay, az = a
    cx, cy, cz = c
    ux, uy, uz = b[0] - ax, b[1] - ay, b[2] - az
    vx, vy, vz = d[0] - cx, d[1] - cy, d[2] - cz
    wx, wy, wz = ax - cx, ay - cy, az - cz
    uu, vv = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz
    uv = ux * vx + uy * vy + uz * vz
    uw, vw = ux * wx + uy * wy + uz * wz, vx * wx + vy * wy + vz * wz
    area = uu * vv - uv * uv
    s = _in_unit((uv * vw - uw * vv) / max(area, LEAST))
    t = _in_unit((uv * s + vw) / max(vv, LEAST))
    s = _in_unit((uv * t - uw) / max(uu, LEAST))
    x, y, z = wx + s * ux - t * vx, wy + s * uy - t * vy, wz + s * uz - t * vz
    return sqrt(x * x + y * y + z * z)


def segment_to_box(a: Point, b: Point, lower: Point, upper: Point) -> float:
    """Distance between the segment a-b and a box along the axes, m; 0.0 where they meet.

    Along the segment the square of the distance to the box is convex, and a parabola between the
    places where the segment crosses the planes of the box's faces: the smallest value lies where
    its slope changes sign.
    """
    axes = [(p, q - p, low, high) for p, q, low, high in zip(a, b, lower, upper, strict=True)]
    crossings = [(wall - p) / u for p, u, *walls in axes if u for wall in walls]
    place = 0.0
    slope = _slope(axes, place)
    if slope < 0.0:
        for t in sorted(set(map(_in_unit, crossings))):
            before, slope_before = place, slope
            place, slope = t, _slope(axes, t)
            if slope >= 0.0:
                place -= (t - before) * slope / (slope - slope_before)
                break
    return sqrt(sum([_outside(p + place * u, low, high) ** 2 for p, u, low, high in axes]))


def shortened(a: Point, b: Point, by: float) -> Point:
    """The point of the segment a-b that lies `by` before its end b; a itself when it is shorter."""
    part = min(by / max(dist(a, b), LEAST), 1.0)
    return (b[0] + part * (a[0] - b[0]), b[1] + part * (a[1] - b[1]), b[2] + part * (a[2] - b[2]))


def _slope(axes: list[tuple[float, float, float, float]], t: float) -> float:
    """Half the slope of the squared distance to the box at the part `t` of the segment."""
    return sum([u * _outside(p + t * u, low, high) for p, u, low, high in axes])


def _outside(x: float, low: float, high: float) -> float:
    """How far a coordinate is beyond its range, with a sign."""
    below, above = x - low, x - high
    return 0.5 * ((below - abs(below)) + (above + abs(above)))


def _in_unit(x: float) -> float:
    return min(max(x, 0.0), 1.0)
