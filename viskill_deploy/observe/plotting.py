"""The parts that all plots of the report share: look, lines, axes, the skills' shading."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np

from viskill_deploy.core.types import FloatArray
from viskill_deploy.observe.records import Mark, RunData

Figure = dict[str, Any]
"""A Plotly figure, or a part of one, as plain data."""

POINTS = 1200
"""Points that one line keeps: more than a plot has pixels."""

_FONT = {"family": "Inter, system-ui, -apple-system, 'Segoe UI', sans-serif", "color": "#334155"}
_GRID = {"gridcolor": "#eef2f7", "linecolor": "#cbd5e1", "zeroline": False, "ticks": ""}


def thinned(time_s: FloatArray, values: FloatArray, points: int = POINTS) -> tuple[Any, Any]:
    """At most about `points` of a line, (n,) each, that keep every peak: each bucket's extremes."""
    if len(values) <= points:
        return numbers(time_s), numbers(values)
    edges = np.linspace(0, len(values), points // 2 + 1).astype(int)
    kept: set[int] = {0, len(values) - 1}
    for low, high in itertools.pairwise(edges):
        bucket = values[low:high]
        kept |= {low + int(np.argmin(bucket)), low + int(np.argmax(bucket))}
    index = sorted(kept)
    return numbers(time_s[index]), numbers(values[index])


def numbers(values: FloatArray) -> list[float | None]:
    """Numbers for JSON, five significant digits; NaN becomes a gap."""
    return [float(f"{v:.5g}") if math.isfinite(v) else None for v in values.tolist()]


def line(x: Any, y: Any, name: str, colour: str, **more: Any) -> Figure:
    """A line through `x` and `y`."""
    style = {"color": colour, "width": 1.6}
    return {"type": "scatter", "mode": "lines", "x": x, "y": y, "name": name, "line": style, **more}


def base_layout(height: int, **more: Any) -> Figure:
    """The layout that every plot starts from, `height` in pixels."""
    return {
        "height": height,
        "font": {**_FONT, "size": 12},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "#ffffff",
        "margin": {"l": 64, "r": 24, "t": 44, "b": 48},
        "hovermode": "x unified",
        "modebar": {"bgcolor": "rgba(0,0,0,0)", "color": "#cbd5e1", "activecolor": "#2563eb"},
        "legend": {"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom"},
        **more,
    }


def axis(title: str = "", **more: Any) -> Figure:
    """An axis in the report's look."""
    return {**_GRID, "title": {"text": title, "standoff": 8}, **more}


def spans(data: RunData) -> list[tuple[float, float, str]]:
    """Start, end and name of each stretch of time that one skill ran."""
    found: list[tuple[float, float, str]] = []
    changes: list[Mark] = []
    for mark in data.marks:
        if not changes or (mark.skill, mark.episode) != (changes[-1].skill, changes[-1].episode):
            changes.append(mark)
    ends = [mark.time_s for mark in changes[1:]] + [data.duration_s]
    for mark, end in zip(changes, ends, strict=True):
        if mark.skill and end > mark.time_s:
            found.append((mark.time_s, end, mark.skill))
    return found


def skill_shading(data: RunData, names: bool) -> Figure:
    """Every second skill's time shaded; its name above when `names`."""
    runs = spans(data)
    shapes = [
        {
            "type": "rect", "xref": "x", "yref": "paper", "x0": start, "x1": end, "y0": 0, "y1": 1,
            "fillcolor": "#e2e8f0" if index % 2 else "#f8fafc", "opacity": 0.55,
            "line": {"width": 0}, "layer": "below",
        }
        for index, (start, end, _) in enumerate(runs)
    ]  # fmt: skip
    notes = [
        {
            "x": (start + end) / 2, "y": 1, "xref": "x", "yref": "paper", "yanchor": "bottom",
            "text": name, "showarrow": False, "font": {"size": 11, "color": "#64748b"},
        }
        for start, end, name in runs
        if end - start > 0.06 * data.duration_s
    ]  # fmt: skip
    return {"shapes": shapes, "annotations": notes if names else []}
