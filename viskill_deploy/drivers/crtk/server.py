"""A simulated dVRK as a process of its own, in real time, on a transport.

Its local socket is for what no robot is told over CRTK: where objects are, what the operator does,
what is to go wrong.
"""

from __future__ import annotations

import argparse
import socket
from pathlib import Path

from pydantic import TypeAdapter

from viskill_deploy.core import realtime
from viskill_deploy.core.description import load_cell
from viskill_deploy.drivers.crtk.opening import Network, open_transport
from viskill_deploy.drivers.crtk.server_options import ServerOptions
from viskill_deploy.drivers.crtk.simulated_cell import CrtkCell
from viskill_deploy.drivers.loopback_server import LoopbackServer
from viskill_deploy.sim.world import World, WorldOptions


def main() -> None:
    """Entry point of the process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cell", required=True)
    parser.add_argument("--socket", type=Path, required=True)
    parser.add_argument("--transport", required=True, help="dds, ros1, ros2 or auto")
    parser.add_argument("--network", default="{}", help="Network, as JSON")
    parser.add_argument("--crtk", default="{}", help="ServerOptions, as JSON")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--options", default="{}", help="WorldOptions, as JSON")
    args = parser.parse_args()
    network = TypeAdapter(Network).validate_json(args.network)
    how = TypeAdapter(ServerOptions).validate_json(args.crtk)
    options = TypeAdapter(WorldOptions).validate_json(args.options)
    world = World(load_cell(args.cell), options, args.seed)
    world.reset(world.scene())  # arms that fall into place would be a tracking error
    transport = open_transport(args.transport, network)
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
            listener.bind(str(args.socket))
            args.socket.chmod(0o600)
            listener.listen()
            realtime.prepare(
                realtime.ROBOT_PRIORITY
            )  # a robot's controller would not wait for other programs either
            LoopbackServer(world, listener, lambda cell: CrtkCell(cell, transport, how)).run()
    finally:
        transport.close()
        realtime.release()  # what is frozen would be reported as leaked at the very end


if __name__ == "__main__":
    main()
