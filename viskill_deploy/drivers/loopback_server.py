"""The loopback as a process of its own, in real time, behind a local socket.

The first client controls. Every further one may only `hold` and `disable`: it is what a watchdog
or a stop button holds on to. When the controlling client goes, the arms hold, as a dVRK's do.
"""

from __future__ import annotations

import argparse
import selectors
import socket
from pathlib import Path

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

SCENE_EVERY = 5
"""Control periods between two looks at the objects (a 50 Hz camera at 4 ms)."""

WATCH_MAY = {"hold", "disable"}


class LoopbackServer:
    """Steps the world in real time and serves its clients between two steps."""

    def __init__(self, world: World, listener: socket.socket) -> None:
        self.cell, self.clock = LoopbackCell(world), MonotonicClock()
        self._listener, self._clients = listener, list[LineSocket]()
        self._waiting = selectors.DefaultSelector()
        listener.setblocking(False)
        self._waiting.register(listener, selectors.EVENT_READ)
        self._stopped = False

    def run(self) -> None:
        """Serves until the controlling client has come and gone, or asked to stop."""
        period, count = self.cell.world.options.period_s, 0
        deadline = self.clock.now()
        while not self._stopped:
            deadline += period
            self._serve_until(deadline)
            self.cell.advance()
            count += 1
            if self._clients:
                self._publish(with_scene=count % SCENE_EVERY == 0)

    def _serve_until(self, deadline: float) -> None:
        while (remaining := deadline - self.clock.now()) > 0:
            for key, _ in self._waiting.select(remaining):
                if key.fileobj is self._listener:
                    self._accept()
                else:
                    self._read(key.data)

    def _accept(self) -> None:
        connection, _ = self._listener.accept()
        client = LineSocket(connection)
        self._clients.append(client)
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
            client.send({"error": f"this handle may only {sorted(WATCH_MAY)}, not {verb}"})
            return
        try:
            self._do(verb, message)
        except (ViskillError, KeyError, TypeError, ValueError) as error:
            client.send({"error": f"{verb}: {error}", "id": message.get("id")})
            return
        if "id" in message:
            answer: Message = {"done": verb, "id": message["id"]}
            if verb == "active_object":
                answer["object"] = pack_object(self.cell.world.active_object())
            client.send(answer)

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
            case "active_object":
                pass
            case "stop":
                cell.disable()
                self._stopped = True
            case _:
                raise DriverError(f"unknown request {verb!r}")

    def _publish(self, with_scene: bool) -> None:
        now = self.clock.now()
        message: Message = {"state": pack_state(self.cell.state(now))}
        if with_scene:
            message["scene"] = pack_scene(self.cell.scene(now))
        try:
            self._clients[0].send(message)
        except DriverError:
            self._drop(self._clients[0])


def main() -> None:
    """Entry point of the process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cell", required=True)
    parser.add_argument("--socket", type=Path, required=True)
    parser.add_argument("--period", type=float, default=0.004)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    world = World(load_cell(args.cell), WorldOptions(period_s=args.period), args.seed)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(args.socket))
        args.socket.chmod(0o600)
        listener.listen()
        LoopbackServer(world, listener).run()


if __name__ == "__main__":
    main()
