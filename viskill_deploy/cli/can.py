"""`viskill can`: arms whose drives hang on CAN, before their first run."""

from __future__ import annotations

import datetime
import enum
from pathlib import Path
from typing import Annotated, Literal, cast

import typer
from rich.console import Console

from viskill_deploy.cli.run_folder import new_folder
from viskill_deploy.cli.sources import Robot
from viskill_deploy.cli.terminal import Terminal
from viskill_deploy.core.clock import wall_time
from viskill_deploy.core.description import CellDescription
from viskill_deploy.drivers.base import Driver
from viskill_deploy.observe.recording import Recorder
from viskill_deploy.runtime.consent import Consent, PersonsConsent
from viskill_deploy.runtime.interrupting import interruptible
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.session import Session
from viskill_deploy.runtime.small_motion import (
    Nudge,
    SimulatorsWitness,
    Witness,
    all_nudges,
    check_small_motions,
    name_of,
)
from viskill_deploy.runtime.small_motion_person import PersonsWitness

EXAMPLE = "Example: viskill can check bipegtransfer --interface socketcan"

SPEED = 0.25

app = typer.Typer(no_args_is_help=True, help="Look after arms whose drives hang on CAN.")


class InterfaceChoice(enum.Enum):
    """What the buses are."""

    SOCKETCAN = "socketcan"
    UDP_MULTICAST = "udp_multicast"

    value: Literal["socketcan", "udp_multicast"]


@app.callback()
def _can() -> None:
    """Look after arms whose drives hang on CAN."""


@app.command("check", epilog=EXAMPLE)
def check(
    file: Annotated[
        str, typer.Argument(help="CAN file: a name in robots/can, or the path of a TOML file.")
    ],
    interface: Annotated[
        InterfaceChoice | None,
        typer.Option(help="What the buses are, if not what the file says."),
    ] = None,
    robot: Robot = "",
    simulated: Annotated[
        bool, typer.Option("--simulated", help="On simulated drives; the simulator is the witness.")
    ] = False,
    output: Annotated[Path | None, typer.Option(help="Folder for the recording.")] = None,
) -> None:
    """Move every axis a little, one after another, and ask you what it did.

    Finds wrong signs, swapped axes, wrong counts and the coupling of another instrument, which no
    encoder shows. Real arms are executed on only after this, and again after every change of the
    file or of an instrument. The consent pedal has to be held all the time.
    """
    from viskill_deploy.drivers.can import driver as real  # noqa: PLC0415 - needs an extra
    from viskill_deploy.drivers.can import simulated as stepped  # noqa: PLC0415
    from viskill_deploy.drivers.can.config import load_with_cell  # noqa: PLC0415
    from viskill_deploy.drivers.can.wiring_check import note_checked  # noqa: PLC0415

    told, cell = load_with_cell(file, interface.value if interface else None, robot)
    console = Console()
    if simulated:
        drives = cast(stepped.SteppedCan, stepped.connect(cell, name=file))
        drives.reset(drives.front.cell.world.scene())  # arms to their start pose
        _try(cell, drives, SimulatorsWitness(drives.side.truth), None, output, console)
        console.print("simulated drives: nothing is noted, no real arm has moved")
        return
    driver = real.CanDriver(cell, told)
    driver.connect()
    terminal = Terminal(console)
    consent = PersonsConsent(driver, terminal.tell)
    _try(cell, driver, PersonsWitness(terminal), consent, output, console)
    stamp = datetime.datetime.fromtimestamp(wall_time(), datetime.UTC).isoformat()
    console.print(f"noted: {note_checked(cell, told, stamp)}", soft_wrap=True)


def _try(
    cell: CellDescription,
    driver: Driver,
    witness: Witness,
    consent: Consent | None,
    output: Path | None,
    console: Console,
) -> None:
    nudges = all_nudges(cell)

    def say(nudge: Nudge) -> None:
        console.print(f"{name_of(cell, nudge)}: as told ({nudge.size:+.3g} {nudge.unit})")

    folder = new_folder(output, f"{cell.name}-small-motions")
    recorder = Recorder(folder / "recording", cell, driver.period_s)
    try:
        recorder.wait_until_open()
        line = Line(cell, driver.period_s, speed=SPEED)
        session = Session(cell, driver, line, recorder, consent=consent)
        with session, interruptible(session):
            check_small_motions(session, witness, nudges, say)
    finally:
        recorder.close()
    console.print(f"{len(nudges)} axes of {len(cell.arms)} arms do as they are told")
