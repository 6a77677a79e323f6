"""The figure of state value against success."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from viskill_deploy.core.errors import MissingExtraError
from viskill_deploy.train.calibration import Calibration
from viskill_deploy.train.reliability import Reliability, pooled

COLOURS = {"low": "#b91c1c", "middle": "#d97706", "high": "#15803d"}

STYLE = {"svg.hashsalt": "viskill", "font.family": "DejaVu Sans", "font.size": 9}
"""A salt, so that the same results give the same file."""


def draw_values(path: Path, tasks: Mapping[str, Sequence[Calibration]]) -> None:
    """An SVG with a row a task: three groups of values, and the reliability curve.

    Args:
        path: where to.
        tasks: calibrations of a task's seeds, by title; pooled for the picture.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        import matplotlib as mpl  # noqa: PLC0415 - slow, and an extra
        from matplotlib.figure import Figure  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise MissingExtraError("train", "the figure of values") from error
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.0, 2.8 * max(1, len(tasks))), layout="constrained")
        panels = figure.subplots(max(1, len(tasks)), 2, squeeze=False)
        for (title, parts), (left, right) in zip(tasks.items(), panels, strict=False):
            _groups(left, title, pooled([part.all for part in parts]))
            _curves(right, parts)
        if not tasks:
            panels[0][0].set_title("not run")
        figure.savefig(path, metadata={"Date": None, "Creator": None})


def _groups(panel: Any, title: str, together: Reliability) -> None:
    for name, group in together.groups.items():
        success = group.success or 0.0
        told = "no episodes" if group.success is None else f"{success:.2f}\nn = {group.count}"
        panel.bar(name, success, color=COLOURS[name], width=0.6)
        panel.annotate(told, (name, success + 0.02), ha="center")
    panel.set(title=title, xlabel="state value", ylabel="success rate", ylim=(0.0, 1.25))


def _curves(panel: Any, parts: Sequence[Calibration]) -> None:
    """One line a skill, all of them together in black."""
    panel.plot([0, 1], [0, 1], color="#94a3b8", linewidth=0.8, linestyle="--")
    for skill in parts[0].skills:
        _curve(panel, pooled([part.skills[skill] for part in parts]), skill, linewidth=0.9)
    together = pooled([part.all for part in parts])
    _curve(panel, together, "all skills", color="black", marker="o", markersize=3)
    panel.set(xlabel="state value", ylabel="success rate", xlim=(0, 1), ylim=(0, 1))
    panel.legend(fontsize="small")


def _curve(panel: Any, shown: Reliability, label: str, **style: Any) -> None:
    points = [(b.value, b.success) for b in shown.bins if b.count]
    panel.plot(*zip(*points, strict=True), label=f"{label} ({shown.episodes})", **style)
