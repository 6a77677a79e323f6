"""`viskill calibrate`: measure a cell, fit what its files do not say, study how well that works."""

from __future__ import annotations

import datetime
import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from viskill_deploy.calibrate.apply import calibration_file
from viskill_deploy.calibrate.board import arm_error_m, on_moved_board, touched_board
from viskill_deploy.calibrate.collect import PARABOLA_S
from viskill_deploy.calibrate.collect import VERSION as COLLECTING
from viskill_deploy.calibrate.fit import ArmFit, fit_arm
from viskill_deploy.calibrate.judge import judge
from viskill_deploy.calibrate.measurements import load
from viskill_deploy.calibrate.parameters import DELAY, NAMES
from viskill_deploy.calibrate.port import port_of
from viskill_deploy.calibrate.study import WAYS, Study, Trial, figures
from viskill_deploy.calibrate.trial_lines import add_line, read_lines
from viskill_deploy.calibrate.truths import MARKER_M, draw_robot, scaled
from viskill_deploy.cli import collect, measure_scene
from viskill_deploy.cli.poses_found import port_facts, port_words, pose_facts, pose_words
from viskill_deploy.cli.sources import Cell
from viskill_deploy.cli.touching import TOUCHES
from viskill_deploy.core.arm_errors import with_errors
from viskill_deploy.core.calibration_files import calibrated, read_calibration, write_calibration
from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.errors import CalibrationError, MotionError, SafetyStop
from viskill_deploy.observe.calibration_report import write_calibration_report
from viskill_deploy.observe.recording import Recorder

app = typer.Typer(
    help="Measure where a cell's arms really are, fit it, and write a calibration.",
    no_args_is_help=True,
)

FIT_EXAMPLE = "Example: viskill calibrate fit runs/points --robot lab.toml -o lab.json"
POINT = Annotated[
    float | None,
    typer.Option(
        help="From the jaw pivot to the measured point along the tip, m. By default what the files "
        "say, else 0."
    ),
]
JSON = Annotated[bool, typer.Option("--json", help="Print one JSON object, nothing else.")]


app.command("collect", epilog=collect.EXAMPLE)(collect.command)
app.command("scene", epilog=measure_scene.EXAMPLE)(measure_scene.command)


@app.command("truth", epilog="Example: viskill calibrate truth 3 -o runs/robot3.json")
def truth_command(
    seed: Annotated[int, typer.Argument(min=0, help="What the robot's errors are drawn from.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The file to write.")],
    cell: Cell = "bipegtransfer",
    scale: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Its errors, as a part of the usual.")
    ] = 1.0,
) -> None:
    """Write a hidden robot to a file, to be looked at, changed, and named with --truth."""
    output.parent.mkdir(parents=True, exist_ok=True)
    robot = scaled(draw_robot(load_cell(cell), seed), scale)
    output.write_text(robot.text(), encoding="utf-8")
    print(output)


@app.command("fit", epilog=FIT_EXAMPLE)
def fit_command(
    folder: Annotated[Path, typer.Argument(help="Measurements, <arm>.csv of every arm.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The calibration to write.")],
    cell: Cell = "bipegtransfer",
    point: POINT = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="Keep this calibration's arms: only the board was moved, and touched anew."
        ),
    ] = None,
    method: Annotated[str, typer.Option(help="How it was measured, for people.")] = "points",
    json_: JSON = False,
) -> None:
    """Fit bases, joint offsets, cables and delay of every arm, and write the calibration.

    Where there is a file of an arm's shaft, `<arm>_shaft.csv`, its port is registered too.
    """
    described = load_cell(cell)
    output.parent.mkdir(parents=True, exist_ok=True)
    if calibration is not None:
        _fit_board(described, folder, calibration, output, json_)
        return
    files = {arm.name: folder / f"{arm.name}.csv" for arm in described.arms}
    fits = {arm.name: fit_arm(arm, load(files[arm.name], point, arm)) for arm in described.arms}
    found = with_errors(described, {name: fit.errors for name, fit in fits.items()})
    shafts = [(arm, folder / f"{arm.name}_shaft.csv") for arm in found.arms]
    ports = {arm.name: port_of(arm, path) for arm, path in shafts if path.exists()}
    taken = min(path.stat().st_mtime for path in files.values())
    created = datetime.datetime.fromtimestamp(taken, datetime.UTC).replace(microsecond=0)
    written = calibration_file(described, fits, files, created, method, ports)
    write_calibration(output, written)
    if json_:
        facts = _facts(fits)
        for name, port in ports.items():
            facts[name]["port"] = port_facts(port)
        print(json.dumps({"calibration": str(output), "arms": facts}))
        return
    console = Console()
    for name, fit in fits.items():
        console.print(_table(name, fit))
        if fit.vector[DELAY] > PARABOLA_S:
            console.print(
                f"{name}: stamps seem {1e3 * fit.vector[DELAY]:.0f} ms late; collect follows "
                f"joints for {1e3 * PARABOLA_S:.0f} ms, so look at the tracker's clock",
                soft_wrap=True,
            )
    for name, port in ports.items():
        console.print(f"{name}: {port_words(port)}", highlight=False)
    console.print(f"Written: {output}")


def _fit_board(
    described: CellDescription, folder: Path, calibration: Path, output: Path, json_: bool
) -> None:
    """Keeps the arms of a calibration and registers the board alone."""
    old = read_calibration(calibration)
    board = touched_board(calibrated(described, old, calibration), arm_error_m(old), folder)
    write_calibration(output, on_moved_board(old, board, folder))
    facts = pose_facts(board)
    if json_:
        print(json.dumps({"calibration": str(output), "board": facts}))
    else:
        print(f"the board: {pose_words(board)}\nWritten: {output}")


@app.command("port", epilog="Example: viskill calibrate port runs/shaft --cell bodytrainer")
def port_command(
    folder: Annotated[Path, typer.Argument(help="Shafts, <arm>_shaft.csv of every arm.")],
    cell: Cell = "bipegtransfer",
    json_: JSON = False,
) -> None:
    """Find the ports of a cell's arms, for `port_in_base_m` of its file.

    A shaft is measured as lines, or, of an arm without a remote centre of its own, by its joints
    while it is moved by hand with the shaft free in the port.
    """
    arms = load_cell(cell).arms
    ports = {arm.name: port_of(arm, folder / f"{arm.name}_shaft.csv") for arm in arms}
    if json_:
        print(json.dumps({name: port_facts(port) for name, port in ports.items()}))
        return
    for name, port in ports.items():
        print(f"{name}: {port_words(port)}")


@app.command("report", epilog="Example: viskill calibrate report runs/points -o report.html")
def report_command(
    folder: Annotated[Path, typer.Argument(help="Measurements, <arm>.csv of every arm.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The page to write.")] = Path(
        "calibration.html"
    ),
    cell: Cell = "bipegtransfer",
    point: POINT = None,
) -> None:
    """Show a fit: residuals before and after, what the data tell, what to expect at the pegs."""
    described = load_cell(cell)
    judged = []
    for index, arm in enumerate(described.arms):
        measured = load(folder / f"{arm.name}.csv", point, arm)
        judged.append(judge(described, index, measured, fit_arm(arm, measured)))
    output.parent.mkdir(parents=True, exist_ok=True)
    print(write_calibration_report(output, cell, judged))


@app.command("study", epilog="Example: viskill calibrate study --truths 50 --json")
def study_command(
    truths: Annotated[int, typer.Option(min=1, help="How many hidden robots.")] = 5,
    seed: Annotated[int, typer.Option(min=0, help="Of truths, poses and noise.")] = 0,
    cell: Cell = "bipegtransfer",
    samples: Annotated[int, typer.Option(min=8, help="Rows of measurements an arm.")] = 300,
    points: Annotated[int, typer.Option(min=8, help="Points that an arm touches.")] = TOUCHES,
    only: Annotated[
        collect.Source | None, typer.Option(help="One way alone; touch takes seconds a robot.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option(help="File of trials; started again it goes on there.")
    ] = None,
    json_: JSON = False,
) -> None:
    """Hide robots, calibrate each by a tracker and by touch, and say how near that comes."""
    described = load_cell(cell)
    ways = WAYS if only is None else (only.value,)
    study = Study(described, seed, samples, points, ways)
    title: dict[str, Any] = {"cell": cell, "seed": seed, "samples": samples, "points": points}
    title |= {"marker_m": MARKER_M, "collect": COLLECTING}
    title |= {} if only is None else {"only": only.value}
    rows = [] if output is None else read_lines(output, title)
    with Progress(console=Console(stderr=True)) as bar:
        shown = bar.add_task("truths", total=truths, completed=len(rows))
        for number in range(len(rows), truths):
            try:
                done = study.truth(number, lambda path, period: Recorder(path, described, period))
                row: dict[str, Any] = {w: [trial.row() for trial in t] for w, t in done.items()}
            except (CalibrationError, MotionError, SafetyStop) as error:
                row = {"failed": str(error)}
            rows.append(row)
            if output is not None:
                add_line(output, row)
            bar.update(shown, completed=len(rows))
    failed = [f"truth {n}: {row['failed']}" for n, row in enumerate(rows) if "failed" in row]
    whole = [row for row in rows if "failed" not in row]
    if not whole:
        raise CalibrationError(f"no robot was calibrated: {'; '.join(failed)}")
    found = {way: figures([Trial.of(trial) for row in whole for trial in row[way]]) for way in ways}
    title |= {"truths": len(rows), "failed": failed}
    if json_:
        touched = {"touch": found["touch"]} if "touch" in found else {}
        print(json.dumps(title | found.get("tracker", {}) | touched))
        return
    for words in failed:
        print(words)
    table = Table(title=f"{len(rows)} hidden robots")
    for column in ("figure", *ways):
        table.add_column(column)
    for name in found[ways[0]]:
        table.add_row(name, *(f"{each[name]:.4g}" for each in found.values()))
    Console().print(table)


def _facts(fits: dict[str, ArmFit]) -> dict[str, Any]:
    return {
        name: {
            "parameters": dict(zip(NAMES, fit.vector.tolist(), strict=True)),
            "frozen": list(fit.frozen),
            "outliers": np.flatnonzero(fit.is_outlier).tolist(),
            "rms_m": fit.rms_m,
            "held_out_median_m": float(np.median(fit.held_out_m)),
            "held_out_p95_m": float(np.quantile(fit.held_out_m, 0.95)),
            "noise_m": fit.noise_m,
            "singular_values": fit.singular_values.tolist(),
        }
        for name, fit in fits.items()
    }


def _table(name: str, fit: ArmFit) -> Table:
    table = Table(title=f"{name}: {(~fit.is_outlier).sum()} of {len(fit.is_outlier)} points")
    table.add_column("parameter")
    table.add_column("found", justify="right")
    table.add_column("sigma", justify="right")
    for key, value, sigma in zip(NAMES, fit.vector, fit.sigma, strict=True):
        words = "the data do not tell" if np.isnan(sigma) else f"{sigma:.2g}"
        table.add_row(key, f"{value:.5f}", words)
    median, p95 = np.quantile(fit.held_out_m, [0.5, 0.95]) * 1e3
    table.caption = (
        f"points that the fit has not seen: median {median:.2f} mm, 95 % within {p95:.2f} mm"
    )
    return table
