"""`viskill execute`: a bundle on a robot, in stages that people dare."""

from __future__ import annotations

import enum
import re
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

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
from viskill_deploy.cli.run_folder import new_folder, show, written_report
from viskill_deploy.cli.sources import Calibration, Inputs, Robot, SceneFile, Truth
from viskill_deploy.cli.terminal import Terminal
from viskill_deploy.core.clock import wall_time
from viskill_deploy.core.errors import (
    CalibrationError,
    Interrupted,
    RecordingError,
    SafetyStop,
    ViskillError,
)
from viskill_deploy.drivers.base import Driver
from viskill_deploy.drivers.crtk.driver import CONSOLE
from viskill_deploy.drivers.crtk.opening import Network
from viskill_deploy.observe.labels import rule_label
from viskill_deploy.observe.preflight_table import print_preflight, summary
from viskill_deploy.observe.recording import Recorder
from viskill_deploy.runtime.dry_run import LAYOUTS
from viskill_deploy.runtime.execution import FIRST_SPEED, ExecuteOptions, execute, look_before
from viskill_deploy.runtime.operator import typed
from viskill_deploy.runtime.poses import PoseLimits, Things
from viskill_deploy.runtime.preflight import Prepared, Sources, prepare
from viskill_deploy.runtime.recovering import recover
from viskill_deploy.runtime.robots import RobotOptions, connected, things_of
from viskill_deploy.sim.world import WorldOptions

EXAMPLE = (
    "Example: viskill execute policies/bipegtransfer-viskill --driver crtk --robot lab.toml "
    "--calibration lab.json --scene scene.toml --rehearse"
)

HEIGHT = re.compile(r"([0-9]+(?:\.[0-9]+)?) ?(mm|cm|m)")
UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


class ModeName(enum.Enum):
    """How the policy is run."""

    PLAN = "plan"
    CLOSED_LOOP = "closed-loop"


class StepName(enum.Enum):
    """Where the arms wait for the operator."""

    SKILL = "skill"
    WAYPOINT = "waypoint"


def command(
    bundle: Annotated[Path, typer.Argument(help="Folder of a policy bundle.")],
    driver: Reached = RobotChoice.LOOPBACK,
    robot: Robot = "",
    calibration: Calibration = None,
    scene: SceneFile = None,
    pose_topic: Annotated[
        str,
        typer.Option(
            help="Topics of a tracker, PoseStamped in the task frame, such as "
            "/scene/{object}/measured_cp; with --scene for what is to be moved where."
        ),
    ] = "",
    pose_age: Annotated[
        float, typer.Option(min=0.02, max=2.0, help="A pose older than this holds the arms, s.")
    ] = 0.5,
    transport: Carrier = TransportChoice.AUTO,
    domain: Domain = None,
    interface: Interface = "",
    pedal: Pedal = CONSOLE,
    mode: Annotated[
        ModeName, typer.Option(help="Plan first and stream, or ask the policy at every step.")
    ] = ModeName.PLAN,
    speed: Annotated[
        float,
        typer.Option(min=0.05, max=1.0, help="Part of full speed; limits of speed go with it."),
    ] = FIRST_SPEED,
    rehearse: Annotated[
        bool,
        typer.Option("--rehearse", help="Read the arms, judge every setpoint, send nothing."),
    ] = False,
    air: Annotated[
        str,
        typer.Option(help="Run the whole plan this high above an empty board, such as 30mm."),
    ] = "",
    step: Annotated[
        StepName | None, typer.Option(help="Pause for Enter before every skill, or every waypoint.")
    ] = None,
    retries: Annotated[
        int,
        typer.Option(
            min=0,
            help="How often a skill is tried again after a lost grasp or where the value is low.",
        ),
    ] = 1,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the simulated cell, and of scripted subgoals.")
    ] = 0,
    realtime: Annotated[
        bool, typer.Option("--realtime", help="Loopback in its own process, against the clock.")
    ] = False,
    truth: Truth = "",
    can: CanFile = "",
    inputs: Inputs = "",
    yes: Yes = False,
    output: Annotated[Path | None, typer.Option(help="Folder for report and recording.")] = None,
    video: Annotated[bool, typer.Option(help="Render the run.")] = True,
    recover_: Annotated[
        bool,
        typer.Option("--recover", help="First clear a FAULT of the arms; asks you to type it."),
    ] = False,
    json_: Annotated[
        bool, typer.Option("--json", help="Print the figures as one JSON object, nothing else.")
    ] = False,
) -> None:
    """Execute a policy bundle on a robot: preflight, consent, approach, run, retreat.

    Nothing is switched on before you have typed the bundle's name. Typing it enables and homes the
    arms, and homing may move an arm without the pedal, as on any dVRK; every other motion waits for
    the consent pedal. Ctrl-C brings the arms to rest and takes their power. Exits with 3 when a
    file or the plan is refused, 4 for the robot, 5 after a safety stop, 130 after Ctrl-C.
    """
    options = ExecuteOptions(
        mode="plan" if mode is ModeName.PLAN else "closed-loop",
        speed=speed,
        seed=seed,
        retries=retries,
        is_rehearsal=rehearse,
        lift_m=_height(air),
        stops=step.value if step else "nowhere",
        has_pedal=bool(inputs),
    )
    if options.mode == "closed-loop" and not options.has_things:
        raise typer.BadParameter("--rehearse and --air run a plan; leave --mode closed-loop out")
    if inputs and driver is RobotChoice.LOOPBACK and not realtime:
        raise typer.BadParameter(
            "--inputs: a person cannot keep up with stepped time; add --realtime"
        )
    if truth and driver is not RobotChoice.LOOPBACK:
        raise typer.BadParameter("--truth hides a robot in the loopback; another is as it is")
    if calibration is None:
        raise CalibrationError(
            "a run on a robot needs its calibration: name it with --calibration, or measure the "
            "cell with `viskill calibrate`"
        )
    prepared = prepare(Sources(bundle, robot, calibration, scene, wall_time()))
    console = Console(stderr=json_)
    network = Network(domain, interface)
    hidden = hidden_robot(truth, prepared.cell) if truth else None
    world = hidden.world(prepared.cell, WorldOptions()) if hidden else WorldOptions()
    chosen = RobotOptions(
        driver.value,
        realtime,
        can=can,
        seed=seed,
        inputs=inputs,
        transport=transport.value,
        network=network,
        console=pedal,
        world=world,
    )
    found = connected(prepared.cell, chosen)
    try:
        _put_things(found.driver, prepared, seed)
        names = [arm.name for arm in prepared.cell.arms]
        limits = PoseLimits(age_s=pose_age)
        things = things_of(found, chosen, prepared.scene, pose_topic, limits, names)
        patience_s = 0.05 if found.driver.capabilities.stepped else 0.0
        terminal = Terminal(console, patience_s)
        if recover_:
            recover(found.arms, terminal)
        _agree(prepared, options, found.driver, things, terminal, console, yes)
        folder = new_folder(output, prepared.name)
        figures, failure = _run(prepared, options, found.driver, things, terminal, folder)
    finally:
        found.close()
    if hidden is not None:
        figures["truth"] = hidden.about
    report = written_report(prepared.cell, figures, folder, video, console)
    show(figures, folder, report, json_, console)
    _judge(figures, failure, report)


def _height(text: str) -> float:
    """A height such as "30mm", m; 0 for none."""
    if not text:
        return 0.0
    match = HEIGHT.fullmatch(text.strip())
    if match is None:
        raise typer.BadParameter(f"--air {text}: say a height with its unit, such as 30mm")
    return float(match[1]) * UNITS[match[2]]


def _put_things(driver: Driver, prepared: Prepared, seed: int) -> None:
    """On a simulated cell, puts the things where the scene file, or a drawn layout, has them."""
    if driver.capabilities.resettable:
        rng = np.random.default_rng([LAYOUTS, seed, 0])
        task, seen = prepared.task, prepared.scene
        driver.reset(seen.scene if seen else task.sample_layout(rng, task.distributions[0]))


def _agree(
    prepared: Prepared,
    options: ExecuteOptions,
    driver: Driver,
    things: Things | None,
    terminal: Terminal,
    console: Console,
    yes: bool,
) -> None:
    """Shows the preflight, says what will happen, and has a person agree to it.

    Raises:
        ViskillError: the preflight failed.
        Interrupted: the person did not agree.
    """
    with console.status("looking at files, robot, scene and the whole plan"):
        checklist = look_before(prepared, options, driver, things)
    title = f"{prepared.name} · cell {prepared.cell.name} · {options.stage}"
    print_preflight(title, checklist.lines, prepared.files, console)
    console.print(summary(checklist.lines), markup=False, highlight=False)
    checklist.insist()
    _say_what_happens(prepared, options, terminal)
    if yes:
        return
    question = f"type {prepared.name} to go on, anything else to leave it"
    if typed(terminal, question) != prepared.name:
        raise Interrupted("not agreed to; nothing was switched on")


def _say_what_happens(prepared: Prepared, options: ExecuteOptions, terminal: Terminal) -> None:
    arms = " and ".join(arm.name for arm in prepared.cell.arms)
    if options.is_rehearsal:
        terminal.tell(f"{arms} are read and sent nothing; the pedal is needed as in a run")
        return
    where = f", {1e3 * options.lift_m:g} mm above the board" if options.lift_m else ""
    terminal.tell(
        f"{arms} are enabled and homed, go to their start pose, run {prepared.name}{where} at "
        f"{100 * options.speed:g} % of full speed, and go back. Homing may move an arm without the "
        "pedal; every other motion waits for it. Keep a hand on the emergency stop: this program "
        "is none"
    )


def _run(
    prepared: Prepared,
    options: ExecuteOptions,
    driver: Driver,
    things: Things | None,
    terminal: Terminal,
    folder: Path,
) -> tuple[dict[str, Any], ViskillError | None]:
    """The run's figures, and what ended it early; both are kept when the recorder fails."""
    period_s, files = driver.period_s, prepared.files
    recorder = Recorder(folder / "recording", prepared.cell, period_s, files=files)
    lost: ViskillError | None = None
    try:
        recorder.wait_until_open()
        outcome = execute(prepared, options, driver, recorder, terminal, things)
    finally:
        driver.close()  # the arms before the record
        try:
            recorder.close()
        except RecordingError as error:
            lost = error
    return outcome.figures, outcome.failure or lost


def _judge(figures: dict[str, Any], failure: ViskillError | None, report: Path) -> None:
    """Raises what the run has to exit with."""
    if isinstance(failure, Interrupted):
        raise failure
    (result,) = figures["episode_results"]
    if figures["interventions"]:
        why = ": ".join(filter(None, (rule_label(result["stopped_by"]), result["reason"])))
        raise SafetyStop(
            f"the gate stepped in and the run was not resumed ({why}); see {report} for the time"
        ) from failure
    if failure is not None:
        raise failure
    if result["refused"]:
        raise SafetyStop(f"{result['refused']}; see {report}")
