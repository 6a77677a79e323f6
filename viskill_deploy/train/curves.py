"""Learning curves of a run: read from its log, for TensorBoard, and as a picture."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from viskill_deploy.core.errors import MissingExtraError
from viskill_deploy.train.lock import alone
from viskill_deploy.train.run import LOG

Line = dict[str, Any]

PICTURE = "curves.png"
EVENTS = "tensorboard"
RATES = ("exploring", "success")
"""What the log gives as rates: of the episodes that explore, and of those that test."""

COLUMNS = 3


def read_log(folder: Path) -> list[Line]:
    """The log of a run, one line a round.

    A run that was stopped repeats the rounds since its last checkpoint, and may leave half a line
    behind: of a repeated round the last line counts, half lines do not.
    """
    path = folder / LOG
    found: dict[tuple[Any, ...], Line] = {}
    for text in path.read_text(encoding="utf-8").splitlines() if path.is_file() else ():
        try:
            line = json.loads(text)
        except json.JSONDecodeError:
            continue
        key = (line.get("stage"), line.get("round"), "ends" in line, "commit" in line)
        found.pop(key, None)
        found[key] = line
    return list(found.values())


def stage_seconds(lines: Iterable[Line]) -> dict[str, float]:
    """Seconds that each stage took, without what was lost when a run was stopped."""
    seconds: dict[str, float] = {}
    for line in lines:
        stage = line["stage"]
        seconds[stage] = round(seconds.get(stage, 0.0) + line.get("seconds", 0.0), 2)
    return seconds


def rates_of(lines: Iterable[Line]) -> dict[str, dict[str, list[float | None]]]:
    """Per stage, its rounds and the rates in each; None where a round has none."""
    curves: dict[str, dict[str, list[float | None]]] = {}
    for line in lines:
        if "round" in line:
            columns = curves.setdefault(line["stage"], {n: [] for n in ("round", *RATES)})
            for name, column in columns.items():
                column.append(line.get(name))
    return curves


def draw(folder: Path, stages: Iterable[str]) -> None:
    """Brings the curves of a run up to date.

    Args:
        folder: of the run.
        stages: whose TensorBoard files are written; the picture shows all that the log knows.

    Raises:
        MissingExtraError: tensorboard or matplotlib is not installed.
    """
    with alone(folder / "curves.lock", lambda _: None):  # methods of one run learn side by side
        lines = read_log(folder)
        for stage in stages:
            rounds = [line for line in lines if line["stage"] == stage and "round" in line]
            if rounds:
                write_events(folder / EVENTS / stage, rounds)
        draw_picture(folder / PICTURE, rates_of(lines))


def write_events(folder: Path, lines: Iterable[Line]) -> None:
    """Every number of every round as a TensorBoard event file, which replaces an earlier one."""
    try:
        from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415 - slow, and an extra
    except ModuleNotFoundError as error:
        raise MissingExtraError("train", "a TensorBoard file") from error
    shutil.rmtree(folder, ignore_errors=True)
    with SummaryWriter(str(folder)) as writer:
        for line in lines:
            for name, value in line.items():
                if isinstance(value, int | float) and name != "round":
                    writer.add_scalar(name, value, int(line["round"]))


def draw_picture(path: Path, curves: Mapping[str, Mapping[str, list[float | None]]]) -> None:
    """The rates of every stage, a panel each, as a PNG."""
    if not curves:
        return
    try:
        from matplotlib.figure import Figure  # noqa: PLC0415 - slow, and an extra
    except ModuleNotFoundError as error:
        raise MissingExtraError("train", "a picture of learning curves") from error
    rows = math.ceil(len(curves) / COLUMNS)
    figure = Figure(figsize=(4.0 * COLUMNS, 2.6 * rows), layout="constrained")
    panels = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
    for panel in panels:
        panel.set_axis_off()
    for panel, (stage, columns) in zip(panels, curves.items(), strict=False):
        panel.set_axis_on()
        for name, marker in zip(RATES, (".", "o"), strict=True):
            points = [
                (x, y)
                for x, y in zip(columns["round"], columns[name], strict=True)
                if y is not None
            ]
            if points:
                panel.plot(*zip(*points, strict=True), marker=marker, label=name)
        panel.set(title=stage, xlabel="round", ylim=(-0.03, 1.03))
        panel.grid(alpha=0.3)
        panel.legend(*panel.get_legend_handles_labels(), fontsize="small", loc="best")
    new = path.with_name(f"new-{path.name}")
    figure.savefig(new, dpi=110)
    new.replace(path)
