"""`viskill serve can`: simulated drives for anybody's master."""

from __future__ import annotations

import contextlib
import enum
import signal
import sys
from typing import Annotated

import typer

from viskill_deploy.calibrate.truths import hidden_robot
from viskill_deploy.cli.sources import Truth
from viskill_deploy.core import realtime
from viskill_deploy.core.clock import MonotonicClock
from viskill_deploy.sim.world import WorldOptions

EXAMPLE = "Example: viskill serve can bipegtransfer --interface udp_multicast"


class Interface(enum.StrEnum):
    """What the buses are."""

    UDP_MULTICAST = "udp_multicast"
    SOCKETCAN = "socketcan"


def command(
    file: Annotated[
        str, typer.Argument(help="CAN file: a name in robots/can, or the path of a TOML file.")
    ] = "bipegtransfer",
    interface: Annotated[
        Interface, typer.Option(help="A group on this machine's loopback, or a kernel's bus.")
    ] = Interface.UDP_MULTICAST,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulated cell.")] = 0,
    truth: Truth = "",
) -> None:
    """Put the simulated cell behind CiA 402 drives, one bus an arm, until Ctrl-C.

    What you type is what the simulated operator does at the input node; there is no consent until
    you type it. docs/can.md has the objects and frames.
    """
    from viskill_deploy.drivers.can.config import load_with_cell  # noqa: PLC0415 - needs an extra
    from viskill_deploy.drivers.can.serving import (  # noqa: PLC0415
        ORDERS,
        DriveServer,
        drive_cell,
    )

    told, cell = load_with_cell(file, interface.value)
    options = WorldOptions(period_s=1.0 / told.cycle_hz)
    world = hidden_robot(truth, cell).world(cell, options) if truth else options
    front = drive_cell(cell, told, seed, world)
    for bus in told.bus:
        load = told.traffic(bus, 1.0 / told.cycle_hz).load
        nodes = ", ".join(f"{axis.joint} {axis.node_id}" for axis in bus.axis)
        print(f"{bus.arm} on {interface.value} {bus.channel}, load {load:.0%}: {nodes}")
    print(f"input node {told.input.node_id} on the bus of {told.input.bus}; type {ORDERS}")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    notes = realtime.prepare(realtime.DRIVES_PRIORITY)
    print("\n".join([*notes, "serving until Ctrl-C"]), flush=True)
    with contextlib.suppress(KeyboardInterrupt), contextlib.closing(front):
        DriveServer(front, MonotonicClock(), sys.stdin.fileno()).run()
    print("the drives are gone")
