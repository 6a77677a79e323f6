"""`viskill guard`: the gate between other people's CRTK programs and a robot."""

from __future__ import annotations

import contextlib
import threading
import weakref
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import typer

from viskill_deploy.cli.reaching import Carrier, Domain, Interface, Pedal, TransportChoice
from viskill_deploy.cli.run_folder import new_folder
from viskill_deploy.cli.sources import Calibration, Cell
from viskill_deploy.cli.terminal import lines_typed
from viskill_deploy.core import realtime
from viskill_deploy.core.calibration_files import insist_real, is_simulated
from viskill_deploy.core.clock import wall_time
from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.core.types import Mode, Verdict
from viskill_deploy.drivers.crtk.driver import CONSOLE, CrtkDriver, CrtkOptions
from viskill_deploy.drivers.crtk.opening import Network, open_transport
from viskill_deploy.drivers.crtk.robot import connect
from viskill_deploy.drivers.crtk.transport import Transport
from viskill_deploy.observe.labels import action_label, rule_label
from viskill_deploy.observe.recording import Recorder
from viskill_deploy.runtime.guard import Guard, GuardCounts
from viskill_deploy.runtime.interrupting import interruptible
from viskill_deploy.runtime.preflight import calibrated_cell

EXAMPLE = "Example: viskill guard --cell lab.toml --calibration lab.json --transport ros2"


def command(
    cell: Cell = "bipegtransfer",
    calibration: Calibration = None,
    transport: Carrier = TransportChoice.AUTO,
    domain: Domain = None,
    interface: Interface = "",
    pedal: Pedal = CONSOLE,
    prefix: Annotated[
        str, typer.Option(help='Prefix of the arms that clients see: "/guarded/PSM1".')
    ] = "guarded",
    rate: Annotated[
        float, typer.Option(min=100, max=1000, help="Setpoints a second that clients send, Hz.")
    ] = 200.0,
    simulated: Annotated[
        bool,
        typer.Option(
            "--simulated",
            help="The robot is a simulated one, such as that of viskill serve crtk: take the "
            "simulated cell as it is.",
        ),
    ] = False,
    output: Annotated[Path | None, typer.Option(help="Folder for the recording.")] = None,
) -> None:
    """Let other CRTK programs move a robot through the gate, until Ctrl-C.

    They send servo_jp (or servo_cp) and jaw/servo_jp to arms under the prefix. What the gate passes
    goes on bit for bit; all else ends in its own stop of all arms. Nothing but homing, which a
    client asks for, moves an arm before the operator presses the pedal; pressed anew, it lets a
    held run go on. What has ended a run is cleared here, by typing "reset".
    """
    if not prefix.strip("/"):
        raise typer.BadParameter("clients need a name that the robot does not have; give --prefix")
    nominal = load_cell(cell)
    _insist_on_its_own_cell(nominal, simulated)
    found = calibrated_cell(nominal, calibration, wall_time())
    described = found.value
    print(f"calibration:  {found.text}", flush=True)
    network = Network(domain, interface, "viskill_guard")
    driver = connect(described, transport.value, network, CrtkOptions(1.0 / rate, pedal))
    with contextlib.ExitStack() as opened:
        opened.callback(driver.close)
        client = open_transport(transport.value, Network(domain, interface, "viskill_guarded"))
        opened.callback(client.close)
        folder = new_folder(output, "guard")
        counts = _guarded(described, driver, client, prefix.strip("/"), folder)
    print(
        f"passed: {counts.passed} cycles; stopped: {counts.stopped} times; lost on the way and "
        f"judged: {counts.filled}\nrecording: {folder / 'recording'}"
    )


def _insist_on_its_own_cell(cell: CellDescription, simulated: bool) -> None:
    """Without its own cell and calibration the gate would look for a robot's arms elsewhere.

    Raises:
        CalibrationError: the cell is a simulated one, and nobody has said that the robot is, too.
        BadParameter: the robot is said to be simulated, and the cell is a real one.
    """
    if not simulated:
        try:
            insist_real(cell)
        except CalibrationError as error:
            raise CalibrationError(
                f"{error}, and its calibration with --calibration; or say with --simulated that "
                "the robot is a simulated one, such as that of `viskill serve crtk`"
            ) from error
    elif not is_simulated(cell):
        raise typer.BadParameter(
            f"--simulated: the arms of {cell.files[0]} have serial numbers; leave it out"
        )


def _guarded(
    cell: CellDescription, driver: CrtkDriver, client: Transport, prefix: str, folder: Path
) -> GuardCounts:
    """Guards until Ctrl-C."""
    with Recorder(folder / "recording", cell, driver.period_s) as recorder:
        recorder.wait_until_open()
        words = (_tell, driver.recover, rule_label, _say)
        guard = Guard(cell, driver, client, recorder, prefix, *words)
        _say_what_is_where(guard, prefix, folder)
        listener = weakref.proxy(guard)  # a thread that waits for ever owns nothing
        threading.Thread(target=_hear_resets, args=(listener, lines_typed()), daemon=True).start()
        realtime.prepare()
        try:
            with interruptible(guard):
                guard.run()
        finally:
            realtime.release()  # what is frozen would be reported as leaked at the very end
    return guard.counts


def _tell(verdicts: Sequence[Verdict], mode: Mode) -> None:
    """One line for what has changed."""
    said = [f"{rule_label(v.rule)}: {action_label(v.action)}" for v in verdicts]
    print(f"{mode.value}{': ' * bool(said)}{'; '.join(dict.fromkeys(said))}", flush=True)


def _say(text: str) -> None:
    """Why arms are stopped, and what the robot's side has to say."""
    print(f"because: {text}", flush=True)


def _say_what_is_where(guard: Guard, prefix: str, folder: Path) -> None:
    arms = ", ".join(f"/{prefix}/{arm.name}" for arm in guard.arms)
    print(
        f"guarded arms: {arms}\n"
        "clients send: servo_jp or servo_cp, jaw/servo_jp, state_command, hold\n"
        'the operator: presses the pedal to agree; "reset" here clears what ended a run\n'
        f"recording:    {folder / 'recording'}\nstop with Ctrl-C",
        flush=True,
    )


def _hear_resets(guard: Guard, lines: Iterable[str]) -> None:
    """A person at this terminal has looked at the arms."""
    for line in lines:
        if line.strip() == "reset":
            guard.is_reset_wanted = True
