"""One self-contained HTML page about a run: figures, tables, plots and the video, no network."""

from __future__ import annotations

import base64
import datetime
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import RecordingError
from viskill_deploy.observe import figures
from viskill_deploy.observe.boundaries import boundary_of, boundary_rows, sentences
from viskill_deploy.observe.faults import struck_rows
from viskill_deploy.observe.labels import action_label, rule_label, with_labels
from viskill_deploy.observe.reading import read_recording
from viskill_deploy.observe.records import RunData
from viskill_deploy.observe.starts import Result, start_rows, value_words
from viskill_deploy.observe.summary import facts, margin_rows, outcome, skill_rows
from viskill_deploy.observe.video import Video

PLOTS = {
    "paths": (
        "Tip paths",
        "Task frame, origin at the centre of the board. Dots mark the start, diamonds subgoals.",
    ),
    "verdicts": ("Verdicts of the gate", "What each rule said, cycle by cycle, under the skills."),
    "joints": ("Joints against limits", "Measured; dotted lines are the arm's limits."),
    "tracking": ("Tracking error", "Setpoint less measured; shading changes with the skill."),
    "remote-centre": (
        "Remote-centre error",
        "Distance of the shaft from the registered port, from measured joints; dotted: warning.",
    ),
}


def write_report(
    path: Path,
    result: Result,
    cell: CellDescription,
    recording: Path | None = None,
    video: Video | None = None,
    episode: int | None = None,
) -> Path:
    """Writes the report of a run.

    Args:
        path: the HTML file to write.
        result: what the run came to, the dict that it prints as JSON.
        cell: the cell that ran.
        recording: the run's bag; without it there are no plots.
        video: outcome of the rendering.
        episode: the episode to plot; None plots the first of the recording.

    A recording that cannot be read, or lacks the episode, becomes a note instead of plots.

    Returns:
        `path`.
    """
    data, trouble = _plotted(recording, result, episode)
    page = environment().get_template("report.html.j2")
    shown = _shown(result, episode)
    html = page.render(
        result=result,
        facts=facts(result),
        skills=skill_rows(result),
        faults=struck_rows(result),
        starts=start_rows(result, shown),
        value_words=value_words(result),
        boundaries=boundary_rows(result, shown),
        shown=shown,
        margins=margin_rows(result),
        episodes=list(result.get("episode_results") or ()),
        about=_about(result, cell, data),
        spoken=_spoken(data),
        notes=_notes(result, shown, video, data, trouble),
        plots=_plots(data, cell),
        plotted=_episode_of(data),
        video=_embedded(video),
        plotly=Markup(plotly_source()) if data is not None else "",
    )
    path.write_text(html, encoding="utf-8")
    return path


def _plotted(
    recording: Path | None, result: Result, episode: int | None
) -> tuple[RunData | None, str]:
    """The episode to plot, and why there is none ("" when there is, or none is asked for)."""
    if recording is None:
        return None, ""
    try:
        data = read_recording(recording, _shown(result, episode))
    except RecordingError as error:
        return None, f"no plots: {error}"
    if not data.duration_s:
        return None, f"no plots: {recording} holds no motion"
    return data, ""


def _shown(result: Result, episode: int | None) -> int | None:
    """The episode to show: the one asked for, or the first that the result knows."""
    known = [e["episode"] for e in result.get("episode_results") or () if "episode" in e]
    return known[0] if episode is None and known else episode


def _episode_of(data: RunData | None) -> int | None:
    return data.marks[0].episode if data is not None and data.marks else None


def environment() -> jinja2.Environment:
    """Where the templates of all pages are."""
    loader = jinja2.FileSystemLoader(Path(__file__).parent / "templates")
    made = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    made.filters["outcome"] = outcome
    made.filters["labelled"] = with_labels
    return made


def plotly_source() -> str:
    """Plotly's own program, to stand in a page that needs no network."""
    from plotly.offline import get_plotlyjs  # noqa: PLC0415 - 5 MB, for a report with plots alone

    return str(get_plotlyjs())


def _about(result: Result, cell: CellDescription, data: RunData | None) -> dict[str, str]:
    """Where the run comes from, by name."""
    rows = {name.capitalize(): str(result[name]) for name in ("bundle", "mode") if name in result}
    if result.get("distribution"):
        rows["Resets"] = str(result["distribution"])
    rows["Cell"] = cell.name
    rows["Arms"] = ", ".join(f"{arm.name} ({arm.arm.robot}, {arm.arm.tool})" for arm in cell.arms)
    if data is not None:
        began = datetime.datetime.fromtimestamp(data.origin_ns * 1e-9).astimezone()
        rows["Plotted"] = f"episode {_episode_of(data)}, {data.duration_s:.1f} s"
        rows["Recorded"] = began.strftime("%Y-%m-%d %H:%M %Z")
        rows["Period"] = f"{1e3 * data.about['period_s']:g} ms"
    return rows


def _spoken(data: RunData | None) -> list[dict[str, Any]]:
    """How often each rule spoke in the plotted episode, and what was done."""
    counts: dict[tuple[str, int], int] = {}
    for row in data.verdicts if data is not None else ():
        if row.rule:
            key = (row.rule, row.action)
            counts[key] = counts.get(key, 0) + 1
    return [
        {"rule": rule_label(rule), "action": action_label(action), "count": count}
        for (rule, action), count in sorted(counts.items())
    ]


def _notes(
    result: Result, shown: int | None, video: Video | None, data: RunData | None, trouble: str
) -> list[str]:
    """What a reader should know first, why the shown episode ended early included."""
    notes = [str(note) for note in result.get("notes") or ()]
    for entry in result.get("episode_results") or ():
        if entry.get("episode") == shown:
            told = [boundary_of(boundary) for boundary in entry.get("boundaries") or ()]
            reasons = [sentence for boundary in told for sentence in sentences(boundary)]
            reasons += entry.get("off_plan") or ()
            reasons += filter(None, (entry.get("reason"), entry.get("refused")))
            notes += [with_labels(f"episode {shown}: {reason}") for reason in reasons]
    notes += [trouble] if trouble else []
    if video is not None and video.note:
        notes.append(video.note)
    if data is not None and not data.complete:
        notes.append("the recording was cut off; what was written before is shown")
    return notes


def _plots(data: RunData | None, cell: CellDescription) -> list[dict[str, Any]]:
    """Sections of plots in the order of the page: title, remark, and the figures in it."""
    if data is None:
        return []
    made = figures.all_figures(data, cell)
    sections = []
    for name, (title, remark) in PLOTS.items():
        parts = [key for key in made if key == name or key.startswith(f"{name}-")]
        shown = [
            {
                "id": key,
                "title": key.removeprefix("joints-") if name == "joints" else "",
                "json": script_json(made[key]),
                "height": made[key]["layout"]["height"],
            }
            for key in parts
        ]
        sections.append({"title": title, "remark": remark, "figures": shown})
    return sections


def script_json(figure: Mapping[str, Any]) -> Markup:
    """JSON that may stand inside a script element: no "<" in it."""
    text = json.dumps(figure, separators=(",", ":"), allow_nan=False)
    return Markup(text.replace("<", "\\u003c"))


def _embedded(video: Video | None) -> str:
    """The video as a data URL, "" without one."""
    if video is None or video.path is None:
        return ""
    return "data:video/mp4;base64," + base64.b64encode(video.path.read_bytes()).decode()
