"""The loopback as a process of its own, in real time, behind a local socket.

The first client controls. Every further one may only `hold` and `disable`: it is what a watchdog
or a stop button holds on to. When the controlling client goes, the arms hold, as a dVRK's do.
"""

from __future__ import annotations

import argparse
import json
import selectors
import socket
from pathlib import Path

from viskill_deploy.core import realtime
from viskill_deploy.core.clock import MonotonicClock
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import DriverError, ViskillError
from viskill_deploy.drivers.loopback_cell import LoopbackCell
from viskill_deploy.drivers.loopback_wire import (
    LineSocket,
    Message,
    pack_object,
    pack_scene,
    pack_state,
    unpack_scene,
    unpack_setpoints,
)
from viskill_deploy.sim.world import World, WorldOptions

LONELY_S = 30.0
"""A server that nobody has connected to ends after this time."""

WATCH_MAY = {"hold", "disable"}


class LoopbackServer:
    """Steps the world in real time and serves its clients between two steps."""

    def __init__(self, world: World, listener: socket.socket) -> None:
        self.cell, self.clock = LoopbackCell(world), MonotonicClock()
        self._listener, self._clients = listener, list[LineSocket]()
        self._waiting = selectors.DefaultSelector()
        listener.setblocking(False)
        self._waiting.register(listener, selectors.EVENT_READ)
        self._stopped = self._had_client = False

    def run(self) -> None:
        """Serves until the controlling client has come and gone, or asked to stop."""
        period = self.cell.world.options.period_s
        deadline = started = self.clock.now()
        while not self._stopped:
            deadline = max(deadline + period, self.clock.now())  # late once, not for ever
            self._serve_until(deadline)
            if not self._had_client and deadline - started > LONELY_S:
                return
            self.cell.advance()
            if self._clients:
                self._publish()

    def _serve_until(self, deadline: float) -> None:
        """Clients are heard in every period, also in one that has no time left."""
        while True:
            remaining = max(deadline - self.clock.now(), 0.0)
            for key, _ in self._waiting.select(remaining):
                if key.fileobj is self._listener:
                    self._accept()
                else:
                    self._read(key.data)
            if self.clock.now() >= deadline:
                return

    def _accept(self) -> None:
        connection, _ = self._listener.accept()
        client = LineSocket(connection)
        self._clients.append(client)
        self._had_client = True
        self._waiting.register(client, selectors.EVENT_READ, client)

    def _read(self, client: LineSocket) -> None:
        try:
            for message in client.receive():
                self._answer(client, message)
        except DriverError:
            self._drop(client)

    def _drop(self, client: LineSocket) -> None:
        self._waiting.unregister(client)
        controlled = self._clients[0] is client
        self._clients.remove(client)
        client.close()
        if controlled:
            self.cell.hold()
            self._stopped = True

    def _answer(self, client: LineSocket, message: Message) -> None:
        verb = str(message.get("do"))
        if client is not self._clients[0] and verb not in WATCH_MAY:
            client.offer(
                {"error": f"this handle may only {sorted(WATCH_MAY)}, not {verb}"}, must_arrive=True
            )
            return
        try:
            self._do(verb, message)
        except (ViskillError, KeyError, TypeError, ValueError) as error:
            client.offer({"error": f"{verb}: {error}", "id": message.get("id")}, must_arrive=True)
            return
        if "id" in message:
            answer: Message = {"done": verb, "id": message["id"]}
            if verb == "active_object":
                answer["object"] = pack_object(self.cell.world.active_object())
            client.offer(answer, must_arrive=True)

    def _do(self, verb: str, message: Message) -> None:
        cell = self.cell
        match verb:
            case "servo_jp":
                cell.servo_jp(unpack_setpoints(message["setpoints"]))
            case "enable" | "home" | "hold" | "disable":
                getattr(cell, verb)()
            case "reset":
                cell.reset(unpack_scene(message["scene"]))
            case "say":
                cell.say(message.get("consent"), message.get("estop"))
            case "break_drive":
                cell.break_drive(message["joint"], message["kind"])
            case "active_object":
                pass
            case "stop":
                cell.disable()
                self._stopped = True
            case _:
                raise DriverError(f"unknown request {verb!r}")

    def _publish(self) -> None:
        now = self.clock.now()
        state, scene = self.cell.state(now), self.cell.scene(now)
        message = {"state": pack_state(state), "scene": pack_scene(scene)}
        try:
            self._clients[0].offer(message)
        except DriverError:
            self._drop(self._clients[0])


def main() -> None:
    """Entry point of the process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cell", required=True)
    parser.add_argument("--socket", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--options", type=json.loads, default={}, help="WorldOptions, as JSON")
    args = parser.parse_args()
    options = WorldOptions(**args.options)
    world = World(load_cell(args.cell), options, args.seed)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(args.socket))
        args.socket.chmod(0o600)
        listener.listen()
        realtime.prepare()  # a robot's controller would not wait for other programs either
        LoopbackServer(world, listener).run()


if __name__ == "__main__":
    main()
