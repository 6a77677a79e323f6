"""`viskill serve`: a simulated robot that other programs can talk to."""

from __future__ import annotations

import enum
import threading
import weakref
from collections.abc import Iterable
from typing import Annotated, Any

import typer

from viskill_deploy.calibrate.truths import hidden_robot
from viskill_deploy.cli import serve_can
from viskill_deploy.cli.reaching import TransportChoice
from viskill_deploy.cli.sources import Cell, Truth
from viskill_deploy.cli.terminal import lines_typed
from viskill_deploy.core import realtime
from viskill_deploy.core.clock import MonotonicClock
from viskill_deploy.core.description import load_cell
from viskill_deploy.drivers.crtk.opening import LOOPBACK, Network, open_transport
from viskill_deploy.drivers.crtk.server_options import ServerOptions
from viskill_deploy.drivers.crtk.serving import run, set_up
from viskill_deploy.drivers.crtk.simulated_cell import CrtkCell
from viskill_deploy.drivers.crtk.tips_on_wire import tip_topic
from viskill_deploy.drivers.crtk.topics import Version
from viskill_deploy.drivers.loopback_cell import LoopbackCell
from viskill_deploy.sim.tracker import TrackerOptions
from viskill_deploy.sim.world import WorldOptions

OPERATOR = "press or release (the pedal), stop or clear (the emergency stop)"
EXAMPLE = "Example: viskill serve crtk --transport dds --arms PSM1,PSM2 --cell bipegtransfer"

app = typer.Typer(
    no_args_is_help=True, help="Serve a simulated robot that other programs can talk to."
)


class VersionChoice(enum.Enum):
    """Which dVRK software is imitated."""

    V24 = "2.4"
    V23 = "2.3"

    value: Version


class HomingChoice(enum.StrEnum):
    """Where arms go when they are homed."""

    DVRK = "dvrk"
    STAY = "stay"


class Announcer:
    """Prints a line when an arm changes its state, warns or errs."""

    def __init__(self) -> None:
        self._told: dict[str, Any] = {}

    def __call__(self, arm: str, event: tuple[str, Any]) -> None:
        """An arm has said something."""
        topic, what = event
        if topic in {"error", "warning"}:
            print(f"{topic}: {what}", flush=True)
        elif topic == "operating_state" and self._told.get(arm) != what:
            self._told[arm] = what
            more = [", homed" * what.is_homed, ", busy" * what.is_busy]
            print(f"{arm}: {what.state}{''.join(more)}", flush=True)


app.command("can", epilog=serve_can.EXAMPLE)(serve_can.command)


@app.command("crtk", epilog=EXAMPLE)
def crtk(
    transport: Annotated[
        TransportChoice, typer.Option(help="ROS 1, ROS 2, or ROS 2's wire without ROS (dds).")
    ] = TransportChoice.AUTO,
    cell: Cell = "bipegtransfer",
    arms: Annotated[
        str, typer.Option(help="Such as PSM1,PSM2; all of the cell's by default.")
    ] = "",
    version: Annotated[
        VersionChoice, typer.Option(help="dVRK software whose names and limits it has.")
    ] = VersionChoice.V24,
    homing: Annotated[
        HomingChoice,
        typer.Option(help="Arms go 12 cm into the cannula, as dVRK's simulation; or they stay."),
    ] = HomingChoice.DVRK,
    rate: Annotated[
        float, typer.Option(min=1, max=250, help="How often readings are published, Hz.")
    ] = 100.0,
    domain: Annotated[
        int | None, typer.Option(min=0, max=232, help="ROS domain; ROS_DOMAIN_ID or 0 by default.")
    ] = None,
    interface: Annotated[
        str, typer.Option(help='Address to be reached at; "" for all. This machine by default.')
    ] = LOOPBACK,
    seed: Annotated[int, typer.Option(min=0, help="Seed of where things lie, and of noise.")] = 0,
    truth: Truth = "",
) -> None:
    """Put the simulated arms on the wire as dVRK arms, until Ctrl-C."""
    names = tuple(name.strip() for name in arms.split(",") if name.strip())
    described, options, tracker = load_cell(cell), WorldOptions(), TrackerOptions()
    if truth:
        hidden = hidden_robot(truth, described)
        options, tracker = hidden.world(described, options), hidden.tracker(described)
    server = ServerOptions(
        version.value, homing.value, rate, arms=names, tracker=tracker, seed=seed
    )
    world = set_up(described, seed, options)
    node = open_transport(transport.value, Network(domain, interface, "viskill_serve"))
    try:
        loopback = LoopbackCell(world)
        front = CrtkCell(loopback, node, server, Announcer())
        typed = weakref.proxy(loopback), lines_typed()  # a thread that waits for ever owns nothing
        threading.Thread(target=be_operator, args=typed, daemon=True).start()
        print(_told(front, node.name, server, interface, truth), flush=True)
        realtime.prepare(
            realtime.ROBOT_PRIORITY
        )  # a robot's controller would not wait for other programs either
        run(front, MonotonicClock())
    except KeyboardInterrupt:
        print("stopped", flush=True)
    finally:
        realtime.release()  # what is frozen would be reported as leaked at the very end
        node.close()


def be_operator(cell: LoopbackCell, lines: Iterable[str]) -> None:
    """Does what is typed at the terminal, as the operator at the console."""
    for line in lines:
        match line.strip():
            case "press" | "release" as word:
                cell.say(consent=word == "press")
            case "stop" | "clear" as word:
                cell.say(estop=word == "stop")
            case other:
                print(f'"{other}" is none of these: {OPERATOR}', flush=True)
                continue
        print(f"operator: {line.strip()}", flush=True)


def _told(
    front: CrtkCell, transport: str, options: ServerOptions, interface: str, truth: str
) -> str:
    """What is to be found where."""
    things = ", ".join(f"/scene/{thing}/measured_cp" for thing in front.cell.world.things)
    where = "this machine only" if interface == LOOPBACK else interface or "all interfaces"
    power = "/system" if options.version == "2.4" else "/console"
    tips = ", ".join(tip_topic(arm.name) for arm in front.cell.world.cell.arms)
    marker = options.tracker.point_m if options.tracker else 0.0
    beyond = f", {1e3 * marker:g} mm beyond the jaw pivots (--point {marker:g})" if marker else ""
    hidden = f"robot:   hidden, truth {truth}\n" if truth else ""
    return (
        f"simulated dVRK {options.version} over {transport}, on {where}\n"
        f"arms:    {', '.join('/' + arm for arm in front.arms)}, at {options.rate_hz:g} Hz\n"
        f"console: {power}/power_on, power_off, home; /console/emulate_operator_present\n"
        f"things:  {things} (no dVRK has these)\n"
        f"tracker: {tips}{beyond}\n"
        f"{hidden}"
        f"type {OPERATOR}\n"
        "stop with Ctrl-C"
    )
