"""What a run leaves behind, on disk and on the screen; `dry-run` and `execute` leave the same."""

from __future__ import annotations

import datetime
import itertools
import json
from pathlib import Path
from typing import Any

import typer
from rich.console import Console

from viskill_deploy.core.clock import wall_time
from viskill_deploy.core.description import CellDescription
from viskill_deploy.observe.report import write_report
from viskill_deploy.observe.tables import print_tables
from viskill_deploy.observe.video import Video, render_video


def new_folder(output: Path | None, name: str) -> Path:
    """A new, empty folder for a run: as named, or by date under `runs`."""
    if output is None:
        moment = datetime.datetime.fromtimestamp(wall_time(), datetime.UTC)
        first = Path("runs") / f"{moment:%Y%m%d-%H%M%S}-{name}"
        numbered = (first.with_name(f"{first.name}-{i}") for i in itertools.count(2))
        output = next(path for path in itertools.chain([first], numbered) if not path.exists())
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise typer.BadParameter(f"{output} is not an empty folder; name a new one with --output")
    output.mkdir(parents=True, exist_ok=True)
    return output


def written_report(
    cell: CellDescription,
    result: dict[str, Any],
    folder: Path,
    video: bool,
    console: Console,
) -> Path:
    """Writes figures, video and report of a run into its folder; returns the report's path."""
    (folder / "result.json").write_text(
        json.dumps(result, indent=2, allow_nan=False) + "\n", encoding="utf-8"
    )
    picture: Video | None = None
    recording = folder / "recording"
    if video and result["setpoints"]:
        with console.status("rendering the video"):
            picture = render_video(recording, folder / "video.mp4", episode=0)
    with console.status("writing the report"):
        return write_report(folder / "report.html", result, cell, recording, picture, 0)


def show(
    result: dict[str, Any], folder: Path, report: Path, as_json: bool, console: Console
) -> None:
    """Prints the figures: one JSON object and nothing else, or tables and where the files are."""
    if as_json:
        print(json.dumps(result, allow_nan=False))
        return
    print_tables(result, console)
    console.print(f"report:    {report}", markup=False, highlight=False, soft_wrap=True)
    console.print(
        f"recording: {folder / 'recording'}", markup=False, highlight=False, soft_wrap=True
    )
