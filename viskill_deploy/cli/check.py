"""`viskill check`: everything that a run looks at before it arms, without arming."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from viskill_deploy.cli.sources import Calibration, Robot, SceneFile
from viskill_deploy.core.clock import wall_time
from viskill_deploy.observe.preflight_table import print_preflight, summary
from viskill_deploy.runtime.checklist import Checklist
from viskill_deploy.runtime.preflight import Prepared, Sources
from viskill_deploy.runtime.rehearsing import preflight

EXAMPLE = "Example: viskill check policies/bipegtransfer-viskill --scene scene.toml"


def command(
    bundle: Annotated[Path, typer.Argument(help="Folder of a policy bundle.")],
    robot: Robot = "",
    calibration: Calibration = None,
    scene: SceneFile = None,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the layout that is drawn where no scene is given.")
    ] = 0,
    json_: Annotated[
        bool, typer.Option("--json", help="Print one JSON object, nothing else.")
    ] = False,
) -> None:
    """Check bundle, robot, calibration, limits, scene and the whole plan; move nothing.

    Every run does the same before it arms the cell. Exits with 3 when a file or the scene is
    refused, with 5 when the gate would not pass the plan.
    """
    checklist, prepared = preflight(Sources(bundle, robot, calibration, scene, wall_time()), seed)
    if json_:
        print(json.dumps(_facts(bundle, checklist, prepared), allow_nan=False))
    else:
        files = prepared.files if prepared else ()
        print_preflight(_title(bundle, prepared), checklist.lines, files, Console())
    print(summary(checklist.lines), file=sys.stderr if json_ or checklist.error else sys.stdout)
    if checklist.error is not None:
        raise typer.Exit(checklist.error.exit_code)


def _title(bundle: Path, prepared: Prepared | None) -> str:
    if prepared is None:
        return str(bundle)
    return f"{prepared.bundle.manifest.name} · cell {prepared.cell.name}"


def _facts(bundle: Path, checklist: Checklist, prepared: Prepared | None) -> dict[str, object]:
    files = prepared.files if prepared else ()
    return {
        "bundle": prepared.bundle.manifest.name if prepared else str(bundle),
        "cell": prepared.cell.name if prepared else None,
        "passed": checklist.error is None,
        "exit_code": checklist.error.exit_code if checklist.error else 0,
        "lines": [line.facts() for line in checklist.lines],
        "files": [{"path": path, "sha256": digest} for path, digest in files],
    }
