"""What has to stay apart in a cell: parts of its arms from each other, and from what stands there.

Everything that stands is a box along the axes of the task frame with a rounding radius: a peg is a
box without a cross-section. Things that are moved (blocks, rings, letters) are not among them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, product
from pathlib import Path

from viskill_deploy.core.cell_files import CellFile
from viskill_deploy.core.description import ArmDescription, CellDescription
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.safety import ceilings
from viskill_deploy.safety.distances import between_segments, segment_to_box, shortened
from viskill_deploy.safety.geometry import Point, Points

PARTS = ("shaft", "wrist", "jaw")
FAR_M = 1.0
"""The board's and the table's top go on to here, and below it everything is board or table."""

KEYS = ("slow_m", "stop_m", "spare_m")
NOWHERE: tuple[Point, Point] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

Box = tuple[str, Point, Point, float]
"""Kind, lower and upper corner, m, and rounding radius, m."""
_Found = tuple[str, tuple[int, int], tuple[int, int], tuple[Point, Point], float]


@dataclass(frozen=True, slots=True)
class Apart:
    """Two things that stay apart.

    Attributes:
        pair: their names, such as "shaft_wrist".
        arms: index of the arm of each; the second is -1 for what stands in the cell.
        parts: which part of each: 0 shaft, 1 wrist, 2 jaw.
        box: corners of what stands in the cell.
        radius: sum of the two radii, m.
        slow, stop: distances of the surfaces, m.
        spare: end of the first part that is not looked at, m.
    """

    pair: str
    arms: tuple[int, int]
    parts: tuple[int, int]
    box: tuple[Point, Point]
    radius: float
    slow: float
    stop: float
    spare: float

    def gap(self, ports: tuple[Point, ...], points: list[Points]) -> float:
        """Distance of the two surfaces, m; minus `radius` when their core lines meet.

        Args:
            ports: registered port of every arm, task frame, m.
            points: ends of the parts of every arm, the same.
        """
        (arm, other), (part, other_part) = self.arms, self.parts
        start, end = _ends(part, ports[arm], points[arm])
        if self.spare:
            end = shortened(start, end, self.spare)
        if other < 0:
            return segment_to_box(start, end, *self.box) - self.radius
        return between_segments(start, end, *_ends(other_part, ports[other], points[other])) - (
            self.radius
        )


def _ends(part: int, port: Point, points: Points) -> tuple[Point, Point]:
    point, jaw_end, wrist, shaft_end = points
    return ((port, shaft_end), (wrist, point), (point, jaw_end))[part]


def clearances(cell: CellDescription) -> tuple[Apart, ...]:
    """Every two things that have to stay apart in `cell`.

    Raises:
        DataFileError: a pair that there is in the cell has no distance and may not touch; or a
            distance is less than the gate accepts, or too large to be meant.
    """
    path, given = cell.files[0], cell.file.distances
    found = list(_found(cell))
    _check_names(path, cell.file, {name for name, *_ in found})
    for name, clearance in given.apart.items():
        slow, stop = ceilings.LEAST_APART.get(name, (math.ulp(0.0), math.ulp(0.0)))
        most_spare = ceilings.MAX_SPARE_M if name == "shaft_wrist" else 0.0
        bounds = ((slow, ceilings.MAX_APART_M), (stop, clearance.slow_m), (0.0, most_spare))
        for key, (low, high) in zip(KEYS, bounds, strict=True):
            value = getattr(clearance, key)
            ceilings.check(path, f"distances.apart.{name}.{key}", value, low, high)
    return tuple(
        Apart(*pair, *(getattr(given.apart[pair[0]], key) for key in KEYS))
        for pair in found
        if pair[0] in given.apart
    )


def _check_names(path: Path, file: CellFile, there: set[str]) -> None:
    """Each pair that there is either stays apart or may touch."""
    apart, contact = set(file.distances.apart), set(file.distances.contact)
    for names, why in (
        (contact - ceilings.MAY_TOUCH, "may never touch; give it a distance under distances.apart"),
        (apart & contact, "both stays apart and may touch; leave out one"),
        (there - apart - contact, "has no distance; give slow_m and stop_m"),
    ):
        if names:
            raise DataFileError(path, f"distances: {min(names)}", why)


def _radii(arm: ArmDescription) -> tuple[float, float, float]:
    """Of shaft, wrist and jaw; a jaw counts as open as it can be, m."""
    shape, jaw = arm.shape, arm.jaw
    opened = jaw.finger_length_m * math.sin(min(max(jaw.upper_rad, 0.0), math.pi) / 2.0)
    return shape.shaft_radius_m, shape.wrist_radius_m, shape.jaw_radius_m + opened


def _found(cell: CellDescription) -> Iterator[_Found]:
    """Every part of every arm with every part of every other, and with all that stands."""
    radii = [_radii(arm.arm) for arm in cell.arms]
    for arms in combinations(range(len(radii)), 2):
        for parts in product(range(len(PARTS)), repeat=2):
            # The thicker part first, so that a pair has one name.
            (a, i), (b, j) = sorted(zip(parts, arms, strict=True))
            yield f"{PARTS[a]}_{PARTS[b]}", (i, j), (a, b), NOWHERE, radii[i][a] + radii[j][b]
    for arm, own in enumerate(radii):
        for part, (kind, lower, upper, radius) in product(range(len(PARTS)), standing(cell.file)):
            name = f"{PARTS[part]}_{kind}"
            yield name, (arm, -1), (part, -1), (lower, upper), own[part] + radius


def standing(file: CellFile) -> Iterator[Box]:
    """What stands in a cell, from its own tables, task frame."""
    yield ("plate", (-FAR_M, -FAR_M, -FAR_M), (FAR_M, FAR_M, 0.0), 0.0)
    for box in file.distances.keep_out:
        yield ("keep_out", box.lower_m, box.upper_m, 0.0)
    if file.board is not None:
        radius, top = file.board.peg_radius_m, file.board.peg_height_m
        for x, y in file.board.peg_xy_m:
            yield ("peg", (x, y, 0.0), (x, y, top - radius), radius)
    if file.wall is not None:
        wall = file.wall
        front, half, radius = wall.front_x_m, wall.width_m / 2.0, wall.peg_radius_m
        back = front - wall.thickness_m
        yield ("plate", (back, -half, -wall.thickness_m), (front, half, wall.height_m), 0.0)
        for y, z in wall.peg_yz_m:
            yield ("peg", (front, y, z), (front + wall.peg_length_m - radius, y, z), radius)
    if file.panel is not None:
        panel = file.panel
        half, (width, length, height) = 1.5 * panel.pitch_m, panel.door_size_m
        yield ("plate", (-half, -half, 0.0), (half, half, panel.plate_top_m), 0.0)
        # Doors and their handles anywhere on their way.
        side, end = panel.pitch_m + width / 2.0, length / 2.0 + panel.door_travel_m
        top = panel.door_height_m + height / 2.0
        yield ("door", (-side, -length / 2.0, 0.0), (side, end, top), 0.0)
        x, y, _ = panel.handle_from_door_m
        knob, reach = panel.knob_radius_m, panel.pitch_m
        top = panel.door_height_m + panel.handle_height_m
        yield ("door", (x - reach, y, 0.0), (x + reach, y + panel.door_travel_m, top), knob)
