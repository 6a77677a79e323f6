"""`viskill reproduce`: the paper's tables with our numbers, from result files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from viskill_deploy.core.errors import MissingExtraError
from viskill_deploy.runtime.preflight import find_bundle

if TYPE_CHECKING:
    from viskill_deploy.calibrate.deployment import Deployment

EXAMPLE = "Example: viskill reproduce docs/results --sweep sweeps/paper.toml"


def command(
    results: Annotated[
        Path, typer.Argument(help="Folder of result files; with --deployment, of trials.")
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="The page, figures beside it; reproduction.md beside the folder of results by "
            "default. With --deployment the page is printed unless this is given.",
        ),
    ] = None,
    sweep: Annotated[
        Path | None,
        typer.Option(help="File of the sweep that wrote the results, to be named on the page."),
    ] = None,
    deployment: Annotated[
        bool,
        typer.Option(
            "--deployment",
            help="The paper's trials on its dVRK, on hidden simulated robots, before and after "
            "their calibration; started again it goes on where it was.",
        ),
    ] = False,
    bundle: Annotated[Path, typer.Option(help="Policy bundle of --deployment.")] = Path(
        "bipegtransfer-viskill"
    ),
    robots: Annotated[int, typer.Option(min=1, help="Hidden robots.")] = 20,
    trials: Annotated[int, typer.Option(min=1, help="Trials of each kind on each robot.")] = 20,
    samples: Annotated[
        int, typer.Option(min=8, help="Rows of measurements an arm to calibrate a robot with.")
    ] = 120,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first hidden robot.")] = 100,
    scale: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Errors of the robots, as a part of the usual.")
    ] = 1.0,
    uncalibrated: Annotated[
        bool, typer.Option("--uncalibrated", help="Calibrate nothing: plan and closed loop alone.")
    ] = False,
    processes: Annotated[int, typer.Option(min=1, help="That share the trials.")] = 1,
    json_: Annotated[
        bool, typer.Option("--json", help="Print the figures of --deployment as one JSON object.")
    ] = False,
) -> None:
    """Build the paper's Tables I and II, the figure of values and the times from result files.

    With --deployment, repeat the paper's trials on a robot instead, on simulated ones (hours).
    """
    if deployment:
        if sweep is not None:
            raise typer.BadParameter("--sweep goes with result files; leave --deployment out")
        from viskill_deploy.calibrate import deployment as job  # noqa: PLC0415 - slow to load

        what = job.Deployment(find_bundle(bundle), robots, trials, samples, seed, scale)
        if uncalibrated:
            what = replace(what, conditions=job.UNCALIBRATED)
        _deploy(what, results, output, processes, json_)
        return
    if json_:
        raise typer.BadParameter("--json goes with --deployment; result files are JSON already")
    try:
        from viskill_deploy.train.reproduce import reproduce  # noqa: PLC0415 - torch is an extra
    except ModuleNotFoundError as error:
        raise MissingExtraError("train", "viskill reproduce") from error
    for path in reproduce(results, output or results.parent / "reproduction.md", sweep):
        print(path)


def _deploy(
    what: Deployment, folder: Path, output: Path | None, processes: int, as_json: bool
) -> None:
    from viskill_deploy.calibrate.deployment import Deployment, run  # noqa: PLC0415 - slow to load
    from viskill_deploy.calibrate.deployment_page import figures, page  # noqa: PLC0415

    console = Console(stderr=True)

    def tell(note: str) -> None:
        console.print(note, highlight=False, markup=False, soft_wrap=True)

    trials = run(what, folder, processes, tell)
    if output is not None:
        command = f"viskill reproduce {folder} --deployment -o {output}"
        usual = Deployment(what.bundle)
        for name in ("robots", "trials", "samples", "seed", "scale"):
            if getattr(what, name) != getattr(usual, name):
                command += f" --{name} {getattr(what, name):g}"
        command += " --uncalibrated" if what.conditions != usual.conditions else ""
        output.parent.mkdir(parents=True, exist_ok=True)
        output.write_text(page(what, trials, command), encoding="utf-8")
    if as_json:
        print(json.dumps(figures(what, trials)))
    elif output is not None:
        print(output)
    else:
        print(page(what, trials, "viskill reproduce --deployment"))
