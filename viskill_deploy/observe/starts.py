"""What was decided at the first step of each skill, in words: subgoal, source, value."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from viskill_deploy.observe.boundaries import sentences
from viskill_deploy.observe.labels import with_labels
from viskill_deploy.runtime.ledger import EpisodeResult

Result = Mapping[str, Any]


def is_low(value: float | None, threshold: float | None) -> bool:
    """Whether a value at a skill's start is below the bundle's threshold, where there are both."""
    return value is not None and threshold is not None and value < threshold


def value_words(result: Result) -> str:
    """What the values at the starts of skills are: a likelihood, or the raw return of a critic."""
    if result.get("value_meaning") == "return":
        return "the chaining policy's action value, which is no probability"
    return "how likely success looked"


@dataclass(frozen=True, slots=True)
class StartRow:
    """What was decided at the first step of one skill of one episode, for people.

    Attributes:
        parts: name and text of every stretch of the subgoal.
        value: P(the whole task succeeds) as seen then, or a return where the bundle says so; None
            where nothing told it.
        low: whether it is below the bundle's threshold.
    """

    skill: str
    source: str
    parts: tuple[tuple[str, str], ...]
    value: float | None
    low: bool


def start_rows(result: Result, episode: int | None) -> list[StartRow]:
    """What was decided at the start of every skill of an episode."""
    layout = result.get("subgoal_layout") or ()
    threshold = result.get("value_threshold")
    return [
        StartRow(
            str(skill["name"]),
            str(skill.get("subgoal_source", "")),
            _parts(skill["subgoal"], layout),
            skill.get("value"),
            is_low(skill.get("value"), threshold),
        )
        for outcome in result.get("episode_results") or ()
        for skill in outcome.get("skills") or ()
        if outcome.get("episode") == episode and skill.get("subgoal")
    ]


def _parts(
    subgoal: Sequence[float], layout: Sequence[Mapping[str, Any]]
) -> tuple[tuple[str, str], ...]:
    """A subgoal in words: positions in mm, the rest as plain numbers."""
    parts, at = [], 0
    for entry in layout or [{"name": "subgoal", "size": len(subgoal)}]:
        name, values = str(entry["name"]), subgoal[at : at + entry["size"]]
        at += entry["size"]
        if name.endswith("position"):
            text = ", ".join(f"{1e3 * value:.1f}" for value in values) + " mm"
        else:
            text = ", ".join(f"{value:g}" for value in values)
        parts.append((name.replace("_", " "), text))
    return tuple(parts)


def remarks(result: EpisodeResult) -> Iterator[str]:
    """What a person should hear of an episode when it is over."""
    for boundary in result.boundaries:
        for sentence in sentences(boundary):
            yield f"episode {result.episode}: {sentence}"
    yield from (f"episode {result.episode}: {sentence}" for sentence in result.off_plan)
    if result.reason or result.refused:
        yield with_labels(f"episode {result.episode}: {result.reason or result.refused}")
