"""`viskill dry-run`: a bundle on the loopback, through the whole line and the gate."""

from __future__ import annotations

import enum
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import qpsolvers
import typer
from rich.console import Console

from viskill_deploy.calibrate.truths import hidden_robot
from viskill_deploy.cli.run_folder import new_folder, show, written_report
from viskill_deploy.cli.sources import Calibration, Inputs, Robot, SceneFile, Truth
from viskill_deploy.core.clock import wall_time
from viskill_deploy.core.errors import Interrupted, RecordingError, SafetyStop, ViskillError
from viskill_deploy.observe.recording import Recorder
from viskill_deploy.observe.starts import remarks
from viskill_deploy.observe.tables import progress
from viskill_deploy.runtime.dry_run import DryRunOptions, dry_run
from viskill_deploy.runtime.faults import Injection, parse_fault
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.preflight import Prepared, Sources, prepare
from viskill_deploy.runtime.replay import PLAN_ENDING, PreparedTrajectory, prepare_trajectory
from viskill_deploy.sim.world import WorldOptions

EXAMPLE = "Example: viskill dry-run policies/bipegtransfer-viskill --episodes 5 --seed 1"

MISSED = 1


class ModeName(enum.StrEnum):
    """How the policy is run."""

    CLOSED_LOOP = "closed-loop"
    PLAN = "plan"


class DriverChoice(enum.StrEnum):
    """What the runtime speaks to."""

    LOOPBACK = "loopback"
    CAN = "can"
    CRTK = "crtk"


class TransportChoice(enum.StrEnum):
    """What carries CRTK."""

    DDS = "dds"
    ROS1 = "ros1"
    ROS2 = "ros2"


RATES = {DriverChoice.LOOPBACK: 250.0, DriverChoice.CAN: 250.0, DriverChoice.CRTK: 200.0}
"""Hz."""


def command(
    bundle: Annotated[
        Path, typer.Argument(help="Folder of a policy bundle, or a *.plan.json of waypoints.")
    ],
    robot: Robot = "",
    calibration: Calibration = None,
    scene: SceneFile = None,
    truth: Truth = "",
    episodes: Annotated[int, typer.Option(min=1, help="How many episodes.")] = 1,
    seed: Annotated[int, typer.Option(min=0, help="Seed of layouts and noise.")] = 0,
    distribution: Annotated[
        str | None,
        typer.Option(
            help="Where each episode's blocks and goal are drawn from: reference (the default) or "
            "wide."
        ),
    ] = None,
    mode: Annotated[
        ModeName, typer.Option(help="Ask the policy at every step, or plan first and stream.")
    ] = ModeName.CLOSED_LOOP,
    rate: Annotated[
        float | None,
        typer.Option(
            min=100, max=1000, help="Control rate, Hz: 250 by default, and 200 with --driver crtk."
        ),
    ] = None,
    realtime: Annotated[
        bool, typer.Option("--realtime", help="Loopback in its own process, against the clock.")
    ] = False,
    driver: Annotated[
        DriverChoice,
        typer.Option(
            help="The simulated cell itself, or behind CiA 402 drives on CAN buses, or as dVRK "
            "arms that speak CRTK."
        ),
    ] = DriverChoice.LOOPBACK,
    inputs: Inputs = "",
    transport: Annotated[
        TransportChoice | None,
        typer.Option(
            help="What carries CRTK with --driver crtk --realtime: dds by default, ROS 2's wire "
            "without ROS; ros1 and ros2 need theirs. Stepped arms are in this process."
        ),
    ] = None,
    ik_solver: Annotated[str, typer.Option(help="QP solver of the IK.")] = "daqp",
    speed: Annotated[
        float,
        typer.Option(min=0.05, max=1.0, help="Part of full speed; limits of speed go with it."),
    ] = 1.0,
    retries: Annotated[
        int,
        typer.Option(
            min=0,
            help="How often in an episode a skill is tried again after a lost grasp or where the "
            "value is low; then, and with 0 at once, the arms go to their start pose and stop.",
        ),
    ] = 1,
    joint_noise: Annotated[
        float, typer.Option(min=0, help="Measurement noise of angles, rad.")
    ] = 0.0,
    insertion_noise: Annotated[
        float, typer.Option(min=0, help="Measurement noise of the insertion, m.")
    ] = 0.0,
    object_noise: Annotated[
        float, typer.Option(min=0, help="Measurement noise of objects, m.")
    ] = 0.0,
    delay: Annotated[int, typer.Option(min=0, help="Control periods from setpoint to effect.")] = 0,
    lag: Annotated[
        float, typer.Option(min=0, help="Time constant with which the arms follow, s.")
    ] = 0.0,
    friction: Annotated[
        bool, typer.Option("--friction", help="Joints have the Coulomb friction of their files.")
    ] = False,
    joint_offset: Annotated[
        float, typer.Option(min=0, help="Error of the angles' zero, standard deviation, rad.")
    ] = 0.0,
    insertion_offset: Annotated[
        float, typer.Option(min=0, help="Error of the insertion's zero, standard deviation, m.")
    ] = 0.0,
    base_error: Annotated[
        float, typer.Option(min=0, help="Error of where an arm stands, standard deviation, m.")
    ] = 0.0,
    base_turn: Annotated[
        float, typer.Option(min=0, help="Error of how an arm is turned, standard deviation, rad.")
    ] = 0.0,
    drops: Annotated[
        float, typer.Option(min=0, max=0.99, help="Part of the messages lost, each way.")
    ] = 0.0,
    jitter: Annotated[
        float, typer.Option(min=0, help="The loop wakes late by up to this, s; not --realtime.")
    ] = 0.0,
    stuck_joint: Annotated[
        str, typer.Option(help="A joint that does not move, such as PSM1/yaw.")
    ] = "",
    fault: Annotated[
        list[str] | None,
        typer.Option(
            help="Something that goes wrong, as name@start[:duration] in seconds, such as "
            "drop@2.0:0.3; may be given again. `viskill faults` lists them."
        ),
    ] = None,
    require_success: Annotated[
        float, typer.Option(min=0, max=1, help="Exit 1 below this success rate.")
    ] = 0.0,
    output: Annotated[Path | None, typer.Option(help="Folder for report and recording.")] = None,
    video: Annotated[bool, typer.Option(help="Render the first episode.")] = True,
    json_: Annotated[
        bool, typer.Option("--json", help="Print the figures as one JSON object, nothing else.")
    ] = False,
) -> None:
    """Dry-run a policy bundle, or a trajectory, on the simulated cell.

    Every setpoint goes through IK, smoothing and the safety gate, as on a robot. Writes a
    recording, figures and a report. Exits with 5 after a safety stop, or where the gate would
    not pass a plan file; with 3 on a bad bundle, or a plan file that cannot be followed.
    """
    prepared = _prepared(Sources(bundle, robot, calibration, scene, wall_time()))
    if scene is not None and distribution is not None:
        raise typer.BadParameter("--scene says where things are; leave --distribution out")
    _check(prepared, distribution, ik_solver)
    joints = [f"{arm.name}/{joint.name}" for arm in prepared.cell.arms for joint in arm.arm.joints]
    if stuck_joint and stuck_joint not in joints:
        raise typer.BadParameter(f"--stuck-joint is one of {', '.join(joints)}")
    if transport is not None and not (driver is DriverChoice.CRTK and realtime):
        raise typer.BadParameter("--transport goes with --driver crtk --realtime")
    world = WorldOptions(
        period_s=1.0 / (rate or RATES[driver]),
        joint_noise_rad=joint_noise,
        joint_noise_m=insertion_noise,
        object_noise_m=object_noise,
        delay_periods=delay,
        joint_friction=friction,
        lag_s=lag,
        joint_offset_rad=joint_offset,
        joint_offset_m=insertion_offset,
        base_error_m=base_error,
        base_error_rad=base_turn,
        drop_rate=drops,
        jitter_s=jitter,
        stuck=stuck_joint,
    )
    hidden = hidden_robot(truth, prepared.cell) if truth else None
    if hidden is not None:
        world = hidden.world(prepared.cell, world)
    options = DryRunOptions(
        episodes=episodes,
        seed=seed,
        distribution=distribution,
        mode="plan" if mode is ModeName.PLAN else "closed-loop",
        world=world,
        real_time=realtime,
        driver=driver.value,
        inputs=inputs,
        transport=(transport or TransportChoice.DDS).value,
        ik_solver=ik_solver,
        speed=speed,
        faults=_faults(fault or (), mode),
        retries=retries,
    )
    if inputs and not realtime:
        raise typer.BadParameter(
            "--inputs: a person cannot keep up with stepped time; add --realtime"
        )
    folder = new_folder(output, prepared.name)
    console = Console(stderr=json_)
    figures, failure = _run(prepared, options, folder, console)
    if hidden is not None:
        figures["truth"] = hidden.about
    report = written_report(prepared.cell, figures, folder, video, console)
    show(figures, folder, report, json_, console)
    if figures["interventions"] and not isinstance(failure, Interrupted):
        raise SafetyStop(
            f"the gate stepped in {figures['interventions']} times; see {report} for rule and time"
        ) from failure
    if failure is not None:
        raise failure
    if figures["success_rate"] < require_success:
        print(
            f"viskill: success {figures['success_rate']:.2f} is below the required "
            f"{require_success:.2f}",
            file=sys.stderr,
        )
        raise typer.Exit(MISSED)


def _prepared(sources: Sources) -> Prepared | PreparedTrajectory:
    """What shall be run: the folder of a bundle, or a plan file."""
    path = sources.bundle
    if not (path.is_file() or path.name.endswith(PLAN_ENDING)):
        return prepare(sources)
    if sources.calibration or sources.scene:
        raise typer.BadParameter("--calibration and --scene go with a policy bundle, not a plan")
    return prepare_trajectory(path, sources.robot)


def _check(
    prepared: Prepared | PreparedTrajectory, distribution: str | None, ik_solver: str
) -> None:
    if distribution is not None and distribution not in prepared.distributions:
        known = ", ".join(prepared.distributions) or "no distributions"
        raise typer.BadParameter(f"{prepared.cell.name} has the distributions {known}")
    solvers = qpsolvers.available_solvers
    if ik_solver not in solvers:
        raise typer.BadParameter(f"installed QP solvers: {', '.join(solvers)}")


def _faults(texts: Sequence[str], mode: ModeName) -> tuple[Injection, ...]:
    """The faults that are asked for, if they can happen in such a run."""
    try:
        faults = tuple(parse_fault(text) for text in texts)
    except ValueError as error:
        raise typer.BadParameter(f"--fault {error}") from error
    names = {injection.fault.name for injection in faults}
    thinking = names & {"slow-policy", "hung-policy"}
    if thinking and mode is ModeName.PLAN:
        raise typer.BadParameter(
            f"--fault {min(thinking)}: a plan is made before anything moves; leave --mode plan out"
        )
    return faults


def _run(
    prepared: Prepared | PreparedTrajectory, options: DryRunOptions, folder: Path, console: Console
) -> tuple[dict[str, Any], ViskillError | None]:
    """The run's figures, and what ended it early; both are kept when the recorder fails."""
    succeeded = 0
    period_s, files = options.world.period_s, prepared.files
    recorder = Recorder(folder / "recording", prepared.cell, period_s, files=files)
    with progress(options.episodes, console) as advance:

        def one_more(result: EpisodeResult) -> None:
            nonlocal succeeded
            succeeded += result.success
            advance(succeeded)
            for remark in remarks(result):
                say(remark)

        def say(note: str) -> None:
            console.print(f"note: {note}", markup=False, style="yellow", soft_wrap=True)

        try:
            recorder.wait_until_open()
            outcome = dry_run(prepared, options, recorder, one_more, say)
        finally:
            try:
                recorder.close()
                lost = None
            except RecordingError as error:
                lost = error
    return outcome.figures, outcome.failure or lost
