"""Simulated drives as a process of their own, in real time, on the buses of a CAN file.

Its local socket is for what no robot is told over CAN: where objects are, what the operator does.
"""

from __future__ import annotations

import argparse
import socket
from pathlib import Path

from pydantic import TypeAdapter

from viskill_deploy.core import realtime
from viskill_deploy.core.description import load_cell
from viskill_deploy.drivers.can.config import CanFile
from viskill_deploy.drivers.can.simulated_cell import DriveCell
from viskill_deploy.drivers.loopback_server import LoopbackServer
from viskill_deploy.sim.world import World, WorldOptions


def main() -> None:
    """Entry point of the process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cell", required=True)
    parser.add_argument("--can", required=True, help="the CAN file, as JSON")
    parser.add_argument("--socket", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--options", default="{}", help="WorldOptions, as JSON")
    args = parser.parse_args()
    file = CanFile.model_validate_json(args.can)
    options = TypeAdapter(WorldOptions).validate_json(args.options)
    world = World(load_cell(args.cell), options, args.seed)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(args.socket))
        args.socket.chmod(0o600)
        listener.listen()
        realtime.prepare(realtime.DRIVES_PRIORITY)
        LoopbackServer(world, listener, lambda cell: DriveCell(cell, file)).run()


if __name__ == "__main__":
    main()
