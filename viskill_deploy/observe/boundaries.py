"""What was decided between the skills, in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from viskill_deploy.core.types import Boundary, GraspTest


@dataclass(frozen=True, slots=True)
class BoundaryRow:
    """One boundary for people.

    Attributes:
        where: before which skill, or in the middle of which.
        grasp: what the jaws told; a dash where none has anything to hold.
        value: P(the whole task succeeds); a dash where nothing tells it.
        course: what is done.
        good: whether the runtime goes on.
    """

    where: str
    grasp: str
    value: str
    course: str
    good: bool


def boundary_of(told: Mapping[str, Any]) -> Boundary:
    """The boundary that a result or a recording tells of."""
    grasps = tuple(GraspTest(**grasp) for grasp in told["grasps"])
    return Boundary(**{**told, "grasps": grasps})


def boundary_rows(result: Mapping[str, Any], episode: int | None) -> list[BoundaryRow]:
    """What was decided between the skills of an episode."""
    return [
        _row(boundary)
        for outcome in result.get("episode_results") or ()
        if outcome.get("episode") == episode
        for boundary in map(boundary_of, outcome.get("boundaries") or ())
    ]


def _row(boundary: Boundary) -> BoundaryRow:
    value = "–" if boundary.value is None else f"{boundary.value:.2f}"
    return BoundaryRow(
        where=place(boundary),
        grasp="; ".join(map(_jaw, boundary.grasps)) or "–",
        value=f"{value}, below {boundary.threshold:.2f}" if boundary.is_value_low else value,
        course=course(boundary),
        good=boundary.course == "go on",
    )


def course(boundary: Boundary) -> str:
    """What is done at a boundary."""
    return {
        "go on": f"{boundary.skill} begins",
        "retry": f"{boundary.skill} is tried again",
        "safe pose": "the arms go to their start pose and stop",
    }[boundary.course]


def place(boundary: Boundary) -> str:
    """Where in the chain it is: before a skill, or in the middle of one."""
    is_within = boundary.before == boundary.after
    return f"{'in' if is_within else 'before'} {boundary.before}"


def sentences(boundary: Boundary) -> Iterator[str]:
    """Why the runtime does not go on, and what it does instead; nothing where it goes on."""
    reasons = [_jaw(grasp) for grasp in boundary.lost]
    if boundary.is_value_low:
        reasons.append(f"value {boundary.value:.2f} is below {boundary.threshold:.2f}")
    if reasons:
        yield f"{place(boundary)}: {', '.join(reasons)}; {course(boundary)}"


def _jaw(grasp: GraspTest) -> str:
    found = "holds" if grasp.holds else "lost its hold" if grasp.is_closed else "is open"
    return f"{grasp.arm} {found} (jaw {grasp.angle_rad:.3f} rad, empty {grasp.empty_rad:.3f} rad)"
