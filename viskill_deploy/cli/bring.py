"""`viskill import`: policies and trajectories that were made elsewhere."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

from viskill_deploy.bundle.format import load_bundle
from viskill_deploy.cli.names import FrameName, PointName
from viskill_deploy.cli.sources import Cell
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import MissingExtraError
from viskill_deploy.motion.frames import Label
from viskill_deploy.motion.resolve import resolve, start_seeds
from viskill_deploy.motion.trajectory import write_plan
from viskill_deploy.motion.waypoints import start_waypoint
from viskill_deploy.observe.trajectory_files import read_written
from viskill_deploy.runtime.replay import PLAN_ENDING
from viskill_deploy.runtime.trajectory import checked_waypoints, look_at, plan_waypoints
from viskill_deploy.sim.tasks.base import load_task, task_names

app = typer.Typer(no_args_is_help=True, help="Bring a policy or a trajectory that you have.")

OFFICIAL_EXAMPLE = "Example: viskill import official exp_local -o policies/mine"


class Subgoals(enum.StrEnum):
    """Where the subgoals come from."""

    CHAINING = "chaining"
    SCRIPTED = "scripted"


@app.command("official", epilog=OFFICIAL_EXAMPLE)
def official(
    folder: Annotated[
        Path, typer.Argument(help="Folder above skill_learning/ and viskill/ of the official code.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="The bundle's folder, new.")],
    task: Annotated[
        str | None, typer.Option(help="BiPegTransfer, BiPegBoard or MatchBoard, if several.")
    ] = None,
    skill_seed: Annotated[int | None, typer.Option(help="Seed of the skills, if several.")] = None,
    chaining_seed: Annotated[
        int | None, typer.Option(help="Seed of the chaining policy, if several.")
    ] = None,
    subgoals: Annotated[
        Subgoals, typer.Option(help="From the chaining policy, or from the task's script.")
    ] = Subgoals.CHAINING,
) -> None:
    """Turn checkpoints of the official ViSkill code into a bundle. Nothing in them is executed."""
    try:
        from viskill_deploy.bundle.official.checkpoint import read_official  # noqa: PLC0415
        from viskill_deploy.bundle.official.convert import write_bundle  # noqa: PLC0415 - an extra
        from viskill_deploy.bundle.official.layout import find_checkpoints  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise MissingExtraError("import", "viskill import official") from error
    scripted = subgoals is Subgoals.SCRIPTED
    if scripted and chaining_seed is not None:
        raise typer.BadParameter("--chaining-seed goes with --subgoals chaining")
    found = find_checkpoints(folder, task, skill_seed, chaining_seed, scripted)
    ours = load_task(found.task)
    policy = read_official(found, ours)
    load_bundle(write_bundle(policy, ours, output, scripted))
    for path in (*found.skills.values(), *filter(None, [found.chaining])):
        print(f"read:   {path}")
    print(f"bundle: {output}")


TRAJECTORY_EXAMPLE = (
    "Example: viskill import trajectory surrol.csv -o mine.plan.json --cell bipegtransfer "
    "--frame surrol --control-point jaw-pivot"
)


@app.command("trajectory", epilog=TRAJECTORY_EXAMPLE)
def trajectory(
    file: Annotated[
        Path, typer.Argument(help="A .csv, .npz, .mcap, .bag, or the folder of a bag.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="The plan file, *.plan.json.")],
    cell: Cell,
    frame: Annotated[
        FrameName | None, typer.Option(help="Where positions are seen from, if the file is silent.")
    ] = None,
    control_point: Annotated[
        PointName | None, typer.Option(help="Point of the tool that positions are about.")
    ] = None,
    length_scale: Annotated[
        float | None, typer.Option(min=1e-3, help="Lengths over metres; the frame's own if left.")
    ] = None,
    step: Annotated[
        float | None, typer.Option(min=1e-3, help="Seconds from waypoint to waypoint.")
    ] = None,
) -> None:
    """Turn Cartesian waypoints into a plan for `viskill dry-run`, after a look for usual traps."""
    if not output.name.endswith(PLAN_ENDING):
        raise typer.BadParameter(f"--output {output}: name a *{PLAN_ENDING}")
    description = load_cell(cell)
    names = [arm.name for arm in description.arms]
    written = read_written(file, names, frame.value if frame else None)
    label = _declared(written.label, frame, control_point, length_scale, file)
    waypoints = checked_waypoints(description, written, label, step, str(file))
    held = resolve(description, [start_waypoint(description)], start_seeds(description))
    plan = plan_waypoints(description, waypoints, held[1], source=str(file))
    write_plan(output, description, waypoints, f"{file.name}, {label}")
    look = look_at(description, waypoints)
    for note in written.notes:
        print(note)
    step_s, took_s = waypoints[0].step_s, plan.motion.duration_s
    own_s, added = step_s * (len(waypoints) - 1), len(plan.waypoints) - 1 - len(waypoints)
    print(f"{len(waypoints)} waypoints read as {label}, {step_s:.4g} s a step")
    print(f"{added} waypoints were added, so that no step is too long")
    print(f"starts {1e3 * look.start_m:.1f} mm from where the arms start")
    times = (
        f", {took_s / own_s:.2f} x the {own_s:.2f} s that the file's steps take" if own_s else ""
    )
    print(f"takes {took_s:.2f} s from where the arms start{times}")
    print(f"plan: {output}")


def _declared(
    said: Label | None,
    frame: FrameName | None,
    point: PointName | None,
    scale: float | None,
    file: Path,
) -> Label:
    """What the numbers mean: by the file, by the options, never by a guess."""
    if said is None:
        if frame is None or point is None:
            raise typer.BadParameter(
                f"{file} does not say what its numbers mean: give --frame and --control-point"
            )
        return Label(frame.value, point.value, scale)
    given = Label(
        frame.value if frame else said.frame,
        point.value if point else said.control_point,
        said.length_scale if scale is None else scale,
    )
    if given != said:
        raise typer.BadParameter(f"{file} says {said}; correct the file or the options")
    return said


ONNX_EXAMPLE = "Example: viskill import onnx policy.onnx --describe policy.toml -o policies/mine"


@app.command("onnx", epilog=ONNX_EXAMPLE)
def onnx(
    policy: Annotated[Path, typer.Argument(help="An .onnx file that holds its own weights.")],
    describe: Annotated[Path, typer.Option(help="A .toml that says what its numbers mean.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="The bundle's folder, new.")],
) -> None:
    """Turn any ONNX policy into a bundle, by a small TOML that says what it sees and answers."""
    try:
        from viskill_deploy.bundle.foreign.convert import write_foreign  # noqa: PLC0415 - an extra
        from viskill_deploy.bundle.foreign.description import Description  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise MissingExtraError("import", "viskill import onnx") from error
    description = Description(describe)
    if description.file.task not in task_names():
        known = ", ".join(task_names())
        raise description.fault("task", f"{description.file.task!r} is unknown; choose of {known}")
    load_bundle(write_foreign(policy, description, load_task(description.file.task), output))
    if description.pivots:
        names = ", ".join(description.pivots)
        print(f"note: {names}: about the jaw pivot, as the task has it, not the jaw end")
    print(f"bundle: {output}")
