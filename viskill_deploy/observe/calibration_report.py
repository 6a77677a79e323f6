"""One HTML page about a calibration: what was wrong, what is left, and what it means at work."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from viskill_deploy.calibrate.judge import Judged
from viskill_deploy.core.types import FloatArray
from viskill_deploy.observe.plotting import Figure, axis, base_layout, line, numbers
from viskill_deploy.observe.report import environment, plotly_source, script_json

BEFORE, AFTER, WRONG = "#94a3b8", "#2563eb", "#b91c1c"

ARROW = 10.0
"""Residuals are drawn this many times as long as they are."""


def write_calibration_report(path: Path, cell: str, arms: Sequence[Judged]) -> Path:
    """Writes the page; returns its path.

    Args:
        path: the HTML file.
        cell: name of the cell.
        arms: what was found of each.
    """
    page = environment().get_template("calibration.html.j2")
    html = page.render(
        cell=cell,
        arms=[_shown(arm) for arm in arms],
        plotly=Markup(plotly_source()),
    )
    path.write_text(html, encoding="utf-8")
    return path


def _shown(arm: Judged) -> dict[str, Any]:
    kept = ~arm.is_outlier
    plots = {
        "residuals": _vectors(arm, kept),
        "distances": _histogram(arm, kept),
        "singular": _singular(arm),
    }
    if len(arm.delay_s):
        plots["delay"] = _delay(arm)
    before = np.linalg.norm(arm.before[kept], axis=1)
    return {
        "name": arm.name,
        "facts": [
            (f"{_mm(np.median(before))} mm", "median error before"),
            (f"{_mm(np.median(arm.held_out_m))} mm", "median error after, points not seen"),
            (f"{_mm(np.quantile(arm.held_out_m, 0.95))} mm", "95 % of those within"),
            (f"{kept.sum()} of {len(kept)}", "points that fit together"),
            (f"{_mm(np.nanmax(arm.expected_m))} mm", "to expect at work, standard deviation"),
        ],
        "parameters": [
            (name, f"{value:.5f}", "" if np.isnan(sigma) else f"{sigma:.2g}")
            for name, value, sigma in arm.parameters
        ],
        "outliers": [int(row) + 1 for row in np.flatnonzero(arm.is_outlier)],
        "places": [
            (*(f"{1e3 * x:.1f}" for x in place), _mm(sigma) if np.isfinite(sigma) else "no reach")
            for place, sigma in zip(arm.places.tolist(), arm.expected_m.tolist(), strict=True)
        ],
        "plots": [
            {"id": f"{arm.name}-{key}", "json": script_json(f), "height": f["layout"]["height"]}
            for key, f in plots.items()
        ],
    }


def _mm(value: Any) -> str:
    return f"{1e3 * float(value):.2f}"


def _vectors(arm: Judged, kept: npt.NDArray[np.bool_]) -> Figure:
    """Residuals as lines in the workspace, `ARROW` times as long."""
    traces = []
    for name, values, colour in (("before", arm.before, BEFORE), ("after", arm.after, AFTER)):
        ends = arm.points + ARROW * values
        x, y, z = (_strokes(arm.points[kept, k], ends[kept, k]) for k in range(3))
        style = {"color": colour, "width": 3}
        traces.append(
            {"type": "scatter3d", "mode": "lines", "x": x, "y": y, "z": z, "name": name}
            | {"line": style, "hoverinfo": "skip"}
        )
    scene = {
        "xaxis": {"title": {"text": "x, mm"}},
        "yaxis": {"title": {"text": "y, mm"}},
        "zaxis": {"title": {"text": "z, mm"}},
        "aspectmode": "data",
    }
    layout = base_layout(460, scene=scene, hovermode=False)
    layout["title"] = {"text": f"Residuals, {ARROW:g} times as long", "font": {"size": 13}}
    return {"data": traces, "layout": layout}


def _strokes(start: FloatArray, end: FloatArray) -> list[float | None]:
    """Start and end of every stroke in mm, with a gap after each."""
    rows = np.stack([start, end, np.full_like(start, np.nan)], axis=1).ravel()
    return numbers(1e3 * rows)


def _histogram(arm: Judged, kept: npt.NDArray[np.bool_]) -> Figure:
    before = np.linalg.norm(arm.before[kept], axis=1)
    bars = [
        {"type": "histogram", "x": numbers(1e3 * values), "name": name, "opacity": 0.75}
        | {"marker": {"color": colour}, "histnorm": "probability", "nbinsx": 40}
        for name, values, colour in (("before", before, BEFORE), ("after", arm.held_out_m, AFTER))
    ]
    layout = base_layout(280, barmode="overlay", xaxis=axis("distance, mm"), yaxis=axis("share"))
    return {"data": bars, "layout": layout}


def _singular(arm: Judged) -> Figure:
    values = np.maximum(arm.singular_values, 1e-3)
    bars = {"type": "bar", "y": numbers(values), "marker": {"color": AFTER}, "name": "data"}
    layout = base_layout(
        260,
        xaxis=axis("direction of parameter space"),
        yaxis=axis("told by the data", type="log"),
        showlegend=False,
    )
    return {"data": [bars], "layout": layout}


def _delay(arm: Judged) -> Figure:
    curve = line(numbers(1e3 * arm.delay_s), numbers(1e3 * arm.delay_rms_m), "moving rows", AFTER)
    layout = base_layout(
        260, xaxis=axis("delay, ms"), yaxis=axis("rms, mm", rangemode="tozero"), showlegend=False
    )
    return {"data": [curve], "layout": layout}
