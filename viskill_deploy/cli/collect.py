"""`viskill calibrate collect`: the arms visit poses through the gate, something sees their tips."""

from __future__ import annotations

import enum
import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress

from viskill_deploy.calibrate.collect import Collected, PointSource, collect
from viskill_deploy.calibrate.programme import choose_poses
from viskill_deploy.calibrate.study import poses_for
from viskill_deploy.calibrate.topic_tips import TopicTips, topics_of
from viskill_deploy.calibrate.truths import hidden_robot
from viskill_deploy.cli.reaching import (
    CanFile,
    Carrier,
    Domain,
    Interface,
    Pedal,
    Reached,
    RobotChoice,
    TransportChoice,
    Yes,
)
from viskill_deploy.cli.sources import Cell, Truth
from viskill_deploy.cli.terminal import Terminal
from viskill_deploy.cli.touching import (
    TOUCH_NOISE_M,
    TOUCHES,
    TouchedBy,
    TouchedRobot,
    collect_by_touch,
)
from viskill_deploy.core import data
from viskill_deploy.core.calibration_files import insist_simulated
from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.errors import Interrupted
from viskill_deploy.core.types import FloatArray
from viskill_deploy.drivers.base import Driver
from viskill_deploy.drivers.crtk.driver import CONSOLE
from viskill_deploy.drivers.crtk.opening import Network, open_transport
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.observe.preflight_table import print_preflight
from viskill_deploy.observe.recording import Recorder
from viskill_deploy.runtime.checklist import Checklist
from viskill_deploy.runtime.consent import PersonsConsent
from viskill_deploy.runtime.execution import FIRST_SPEED
from viskill_deploy.runtime.interrupting import interruptible
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.readiness import look_at_robot
from viskill_deploy.runtime.robots import RobotOptions, connected
from viskill_deploy.runtime.session import Session
from viskill_deploy.sim.tasks.base import load_task
from viskill_deploy.sim.tracker import SimulatedTracker, TrackerOptions
from viskill_deploy.sim.world import WorldOptions

EXAMPLE = "Example: viskill calibrate collect runs/points --driver crtk --robot lab.toml"


class Source(enum.StrEnum):
    """How points are measured."""

    TRACKER = "tracker"
    TOUCH = "touch"


def command(
    folder: Annotated[Path, typer.Argument(help="Where the measurements go, a file an arm.")],
    cell: Cell = "bipegtransfer",
    source: Annotated[
        Source,
        typer.Option(
            help="tracker: the arms visit poses, a tracker sees their tips. touch: a person "
            "brings the tips to points of the board, nothing is sent to any arm."
        ),
    ] = Source.TRACKER,
    driver: Reached = RobotChoice.LOOPBACK,
    samples: Annotated[int, typer.Option(min=8, help="Rows of the tracker, an arm.")] = 300,
    points: Annotated[int, typer.Option(help="Points to touch, an arm; at least 8.")] = TOUCHES,
    seed: Annotated[int, typer.Option(min=0, help="Seed of poses, and of simulated noise.")] = 0,
    tracker: Annotated[
        str, typer.Option(help="Topics of a tracker of the tips, PoseStamped in the task frame.")
    ] = "/tracker/{arm}/measured_cp",
    transport: Carrier = TransportChoice.AUTO,
    domain: Domain = None,
    interface: Interface = "",
    pedal: Pedal = CONSOLE,
    can: CanFile = "",
    speed: Annotated[
        float | None,
        typer.Option(min=0.05, max=1.0, help="Part of full speed: 0.25, or 1 on the loopback."),
    ] = None,
    yes: Yes = False,
    point: Annotated[
        float | None,
        typer.Option(
            min=0,
            help="From the jaw pivot to what the tracker sees, along the tip, m: 0 on a robot, "
            "the truth's on the loopback, unless you say so.",
        ),
    ] = None,
    truth: Truth = "",
    noise: Annotated[
        float | None,
        typer.Option(
            min=0,
            help="Noise of the loopback's tracker, m, the truth's by default; 0.0003 of a touch.",
        ),
    ] = None,
    outliers: Annotated[
        float | None,
        typer.Option(min=0, max=0.5, help="Part of its points that are wrong, likewise."),
    ] = None,
    json_: Annotated[
        bool, typer.Option("--json", help="Print one JSON object, nothing else.")
    ] = False,
) -> None:
    """Measure points of every arm's tip.

    Started again, it goes on where it was, whatever had ended it. Measurements of another tracker
    need no collecting: write them as CSV and go on with `viskill calibrate fit`.
    """
    described, console = load_cell(cell), Console(stderr=True)
    network = Network(domain, interface)
    if source is Source.TOUCH:
        if driver is RobotChoice.CAN:
            raise typer.BadParameter("--source touch listens to the loopback or to CRTK")
        if point is not None:
            raise typer.BadParameter("--point is the tracker's; a jaw's end touches")
        who = TouchedBy(
            TouchedRobot(driver.value),
            transport.value,
            network,
            hidden_robot(truth, described) if truth else None,
            TOUCH_NOISE_M if noise is None else noise,
            outliers or 0.0,
            seed,
        )
        _show(collect_by_touch(described, folder, points, who), json_)
        return
    count = poses_for(samples)
    poses = np.stack(
        [choose_poses(described, arm, count, seed) for arm in range(len(described.arms))], axis=1
    )
    programme = f"cell {described.name}, {count} poses, seed {seed}, "
    if driver is RobotChoice.LOOPBACK:
        insist_simulated(described)
        loopback, seen = _hidden(described, truth, (noise, outliers, point), seed)
        line = Line(described, loopback.period_s, speed=speed or 1.0)
        programme += f"truth {truth or None}"
        found = _collect(described, loopback, seen, line, poses, folder, programme, console)
    else:
        if truth or noise is not None or outliers is not None:
            raise typer.BadParameter("--truth, --noise and --outliers are the loopback's")
        options = RobotOptions(
            driver.value, can=can, transport=transport.value, network=network, console=pedal
        )
        robot = connected(described, options)
        try:
            robot.node = robot.node or open_transport(options.transport, network)
            arms = [arm.name for arm in described.arms]
            tips = TopicTips(robot.node, topics_of(tracker, arms), point or 0.0)
            tips.insist()
            terminal = Terminal(console)
            _agree(described, robot.driver, terminal, console, yes)
            line = Line(described, robot.driver.period_s, speed=speed or FIRST_SPEED)
            programme += driver.value
            found = _collect(
                described, robot.driver, tips, line, poses, folder, programme, console, terminal
            )
        finally:
            robot.close()
    if found.skipped:
        console.print(
            f"{found.skipped} poses were left out: the gate would have stepped in, or has, because "
            "something was in an arm's way."
        )
    _show({"files": {name: str(path) for name, path in found.files.items()}}, json_)


def _show(found: dict[str, Any], as_json: bool) -> None:
    """Prints where the measurements are."""
    if as_json:
        print(json.dumps(found))
        return
    for path in found["files"].values():
        print(path)


def _hidden(
    cell: CellDescription,
    truth: str,
    wished: tuple[float | None, float | None, float | None],
    seed: int,
) -> tuple[LoopbackDriver, SimulatedTracker]:
    """The loopback as a hidden robot, and its tracker; noise, outliers and point as wished."""
    world, seen = WorldOptions(), TrackerOptions()
    if truth:
        hidden = hidden_robot(truth, cell)
        world, seen = hidden.world(cell, world), hidden.tracker(cell)
    noise, share, point = wished
    seen = replace(
        seen,
        noise_m=seen.noise_m if noise is None else noise,
        outlier_share=seen.outlier_share if share is None else share,
        point_m=seen.point_m if point is None else point,
    )
    driver = LoopbackDriver(cell, world, seed)
    driver.connect()
    task = load_task(cell.name, cell)
    driver.reset(task.sample_layout(np.random.default_rng(seed), task.distributions[0]))
    return driver, SimulatedTracker(driver.world, seen, seed)


def _agree(
    cell: CellDescription, driver: Driver, terminal: Terminal, console: Console, yes: bool
) -> None:
    """Looks at the robot, says what will happen, and has a person agree to it.

    Raises:
        ViskillError: something is against it.
        Interrupted: the person did not agree.
    """
    checklist = Checklist()
    look_at_robot(checklist, driver, cell)
    files = data.digests(cell.files)
    print_preflight(f"calibrate collect · cell {cell.name}", checklist.lines, files, console)
    checklist.insist()
    arms = " and ".join(arm.name for arm in cell.arms)
    terminal.tell(
        f"{arms} are enabled and homed, go to their start pose and then all over their workspace, "
        "above where the board is meant to be. Homing may move an arm without the pedal; every "
        "other motion waits for it. Take the board and everything on it away; leave the "
        "instruments in. Tips that are not calibrated may be 15 mm from where they are meant to "
        "be. Keep a hand on the emergency stop: this program is none"
    )
    if yes:
        return
    terminal.ask(f"type {cell.name} to go on, anything else to leave it")
    while (answer := terminal.answer()) is None:
        pass
    if answer.strip() != cell.name:
        raise Interrupted("not agreed to; nothing was switched on")


def _collect(
    cell: CellDescription,
    driver: Driver,
    source: PointSource,
    line: Line,
    poses: FloatArray,
    folder: Path,
    programme: str,
    console: Console,
    operator: Terminal | None = None,
) -> Collected:
    folder.mkdir(parents=True, exist_ok=True)
    consent = PersonsConsent(driver, operator.tell) if operator is not None else None
    with (
        Recorder(_free(folder / "recording"), cell, driver.period_s) as recorder,
        Session(cell, driver, line, recorder, consent=consent) as session,
        interruptible(session),
        Progress(console=console) as bar,
    ):
        tasks = {what: bar.add_task(what, total=len(poses)) for what in ("planned", "measured")}
        return collect(
            session,
            source,
            poses,
            folder,
            programme,
            lambda what, n: bar.update(tasks[what], completed=n),
            operator,
        )


def _free(path: Path) -> Path:
    """`path`, or the first `path`-2, -3 … that is not there: every call has its own recording."""
    number = 1
    while path.exists():
        number += 1
        path = path.with_name(f"{path.name.rsplit('-', 1)[0]}-{number}")
    return path
