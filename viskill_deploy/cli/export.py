"""`viskill export`: a training run as a bundle, a plan for another player, CAN for other tools."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from typer.core import TyperGroup

from viskill_deploy.cli.names import FrameName, PointName
from viskill_deploy.cli.sources import Robot
from viskill_deploy.core.errors import MissingExtraError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.motion.frames import Label
from viskill_deploy.motion.resolve import resolve, start_seeds
from viskill_deploy.motion.trajectory import written_of
from viskill_deploy.motion.waypoints import start_waypoint
from viskill_deploy.observe.trajectory_files import JointNames, write_joint_plan, write_written
from viskill_deploy.runtime.trajectory import open_plan, plan_waypoints

EXAMPLE = "Example: viskill export runs/viskill runs/mine"
TRAJECTORY_EXAMPLE = "Example: viskill export trajectory mine.plan.json joints.csv --rate 200"

CAN_EXAMPLE = "Example: viskill export can bipegtransfer can-files"


class _RunFirst(TyperGroup):
    """`viskill export RUN OUT` needs no name of a command."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """What is no command's name belongs to the command for training runs."""
        if args and args[0] not in {*self.commands, "-h", "--help"}:
            args = ["run", *args]
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=_RunFirst,
    no_args_is_help=True,
    help="Export a training run as a policy bundle, or a plan or CAN files for your own tools.",
)


@app.command("run", epilog=EXAMPLE)
def command(
    run: Annotated[Path, typer.Argument(help="Folder that `viskill train` wrote.")],
    output: Annotated[Path, typer.Argument(help="The bundle's folder.")],
    method: Annotated[
        str, typer.Option(help="Whose chaining policy, of those trained in the folder.")
    ] = "viskill",
    episodes: Annotated[
        int, typer.Option(min=0, help="Episodes to measure in each distribution.")
    ] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Seed of those episodes.")] = 0,
    threshold: Annotated[
        float,
        typer.Option(
            min=0.0, max=1.0, help="Probability of success below which the runtime does not go on."
        ),
    ] = 0.5,
) -> None:
    """Export a training run as ONNX graphs with manifest and model card, and measure it."""
    try:
        from viskill_deploy.cli.learning_display import StageBars  # noqa: PLC0415 - torch
        from viskill_deploy.train.export import export, load_trained  # noqa: PLC0415 - an extra
        from viskill_deploy.train.run import Run  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise MissingExtraError("train", "viskill export") from error
    with StageBars(Console()) as bars:
        opened = Run.open(run, bars.say)
        opened.watch = bars.watch
        export(load_trained(opened, method), output, episodes, seed, bars.say, threshold)


@app.command("trajectory", epilog=TRAJECTORY_EXAMPLE)
def trajectory(
    plan: Annotated[Path, typer.Argument(help="A *.plan.json of `viskill import trajectory`.")],
    output: Annotated[Path, typer.Argument(help="A .csv, a .npz, or a new folder for a bag.")],
    robot: Robot = "",
    rate: Annotated[float, typer.Option(min=10, max=2000, help="Setpoints a second.")] = 250.0,
    speed: Annotated[
        float, typer.Option(min=0.05, max=1.0, help="Part of the planned tip speed to use.")
    ] = 1.0,
    waypoints: Annotated[
        bool, typer.Option("--waypoints", help="Write the waypoints, not the smoothed joints.")
    ] = False,
    frame: Annotated[FrameName, typer.Option(help="Frame of the waypoints.")] = FrameName.CRTK,
    control_point: Annotated[
        PointName, typer.Option(help="Point of the tool that they are about.")
    ] = PointName.JAW_PIVOT,
) -> None:
    """Write the resolved, smoothed joint plan, or its waypoints in any frame, for your own player.

    Joint plans start where the cell's arms start. What plays them has no gate of
    its own: play them through `viskill guard`, at the same rate.
    """
    cell, points = open_plan(plan, robot)
    if waypoints:
        label = Label(frame.value, control_point.value)
        write_written(output, written_of(cell, points, label))
        print(f"{len(points)} waypoints, {label}: {output}")
        return
    home = resolve(cell, [start_waypoint(cell)], start_seeds(cell))[1]
    motion = plan_waypoints(cell, points, home, speed, str(plan)).motion
    table: FloatArray = np.ascontiguousarray(motion.table(1.0 / rate)[:, :, :2])
    arms = [
        JointNames(arm.name, (*(joint.name for joint in arm.arm.joints), "jaw"))
        for arm in cell.arms
    ]
    write_joint_plan(output, 1.0 / rate, table, arms)
    print(f"{len(table)} setpoints an arm, {motion.duration_s:.2f} s: {output}")


@app.command("can", epilog=CAN_EXAMPLE)
def can(
    file: Annotated[
        str, typer.Argument(help="CAN file: a name in robots/can, or the path of a TOML file.")
    ],
    output: Annotated[Path, typer.Argument(help="Folder for the files.")],
) -> None:
    """Write a DBC of every bus and a DCF (EDS with values) of every drive, for your own tools."""
    from viskill_deploy.drivers.can.config import load_with_cell  # noqa: PLC0415 - as below
    from viskill_deploy.drivers.can.export import export  # noqa: PLC0415 - `export` is taken here

    written = export(load_with_cell(file)[0], output)
    print("\n".join(map(str, written)))
