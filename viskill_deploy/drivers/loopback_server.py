"""The loopback as a process of its own, in real time, behind a local socket.

The first client controls. Every further one may only look, `hold` and `disable`: it is what a
watchdog or a stop button holds on to, and its hold lasts until the arms are enabled again. When
the controlling client goes, its last setpoint is held for ever, as on a dVRK; nobody else takes
its place, and the server ends with its last client.
"""

from __future__ import annotations

import argparse
import selectors
import socket
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from pydantic import TypeAdapter

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
"""A server that nobody controls ends after this time."""

LOOKED_AT_S = 0.02
"""Behind a front the private socket is for people's eyes: it says where things are at 50 Hz, as a
tracker does. Packing that in every period would take a third of the server's time."""

STOPS = {"hold": LoopbackCell.pause, "disable": LoopbackCell.disable}
"""What a client that does not control may do."""


class Line(Protocol):
    """What a front waits on."""

    def fileno(self) -> int:
        """Of its socket; -1 without one."""
        ...


class Front(Protocol):
    """What stands between the clients of another protocol and a cell."""

    @property
    def lines(self) -> Sequence[Line]:
        """Where its clients speak."""
        ...

    def poll(self, now: float) -> None:
        """Hears and answers."""
        ...

    def advance(self, now: float) -> None:
        """One control period of itself and the cell."""
        ...

    def cause(self, fault: str, arm: str, is_on: bool) -> None:
        """Begins or ends something that goes wrong; raises DriverError for what it has not."""
        ...

    def heard(self) -> Message:
        """What has arrived of setpoints, for figures; {} where nobody counts."""
        ...


class LoopbackServer:
    """Steps the world in real time and serves its clients between two steps.

    Args:
        world: the physics.
        listener: where clients come.
        front: what stands between clients and the cell; None where they command it themselves.
    """

    def __init__(
        self,
        world: World,
        listener: socket.socket,
        front: Callable[[LoopbackCell], Front] | None = None,
    ) -> None:
        self.cell, self.clock = LoopbackCell(world), MonotonicClock()
        self._front = front(self.cell) if front is not None else None
        self._listener, self._clients = listener, list[LineSocket]()
        self._waiting = selectors.DefaultSelector()
        listener.setblocking(False)
        self._waiting.register(listener, selectors.EVENT_READ)
        self._controller: LineSocket | None = None
        self._stopped = self._had_client = False
        self._alone_since = self.clock.now()
        for line in self._front.lines if self._front is not None else ():
            if line.fileno() >= 0:
                self._waiting.register(line, selectors.EVENT_READ, self._front)
        self._told_s = -LOOKED_AT_S
        self._stopped_s: dict[str, float] = {}  # when a client that only watches first did what

    def run(self) -> None:
        """Serves until all clients have come and gone, or the controlling one asked to stop."""
        period = self.cell.world.options.period_s
        deadline = self.clock.now()
        while not self._stopped:
            deadline = max(deadline + period, self.clock.now())  # late once, not for ever
            self._serve_until(deadline)
            if self._controller is None and deadline - self._alone_since > LONELY_S:
                return
            if self._front is None:
                self.cell.advance()
            else:
                self._front.advance(self.clock.now())
            if self._controller is not None and self._is_to_be_told():
                self._publish(self._controller)

    def _serve_until(self, deadline: float) -> None:
        """Clients are heard in every period, also in one that has no time left."""
        while True:
            remaining = max(deadline - self.clock.now(), 0.0)
            for key, _ in self._waiting.select(remaining):
                if key.fileobj is self._listener:
                    self._accept()
                elif key.data is self._front and self._front is not None:
                    self._front.poll(self.clock.now())
                else:
                    self._read(key.data)
            if self.clock.now() >= deadline:
                return

    def _accept(self) -> None:
        connection, _ = self._listener.accept()
        client = LineSocket(connection)
        self._clients.append(client)
        if not self._had_client:
            self._controller, self._had_client = client, True
        self._waiting.register(client, selectors.EVENT_READ, client)

    def _read(self, client: LineSocket) -> None:
        try:
            for message in client.receive():
                self._answer(client, message)
        except DriverError:
            self._drop(client)

    def _drop(self, client: LineSocket) -> None:
        self._waiting.unregister(client)
        self._clients.remove(client)
        client.close()
        if client is self._controller:
            self._controller, self._alone_since = None, self.clock.now()
        self._stopped = self._stopped or not self._clients

    def _answer(self, client: LineSocket, message: Message) -> None:
        verb = str(message.get("do"))
        try:
            if client is self._controller:
                self._do(verb, message)
            else:
                self._stop(client, verb)
        except (ViskillError, KeyError, TypeError, ValueError) as error:
            client.offer({"error": f"{verb}: {error}", "id": message.get("id")}, must_arrive=True)
            return
        if "id" in message:
            answer: Message = {"done": verb, "id": message["id"]}
            if verb == "active_object":
                answer["object"] = pack_object(self.cell.world.active_object())
            if verb == "look":  # what a client that did not read has missed is not sent again
                now = self.clock.now()
                answer["state"] = pack_state(self.cell.state(now))
                answer["scene"] = pack_scene(self.cell.scene(now))
            if verb == "heard" and self._front is not None:
                answer["heard"] = self._front.heard()
            client.offer(answer, must_arrive=True)

    def _do(self, verb: str, message: Message) -> None:
        cell = self.cell
        match verb:
            case "servo_jp" | "enable" | "home" | "hold" if self._front is not None:
                raise DriverError(f"{verb} goes over the bus here")
            case "servo_jp":
                cell.servo_jp(unpack_setpoints(message["setpoints"]))
            case "enable" | "home" | "hold" | "disable":
                getattr(cell, verb)()
            case "reset":
                cell.reset(unpack_scene(message["scene"]))
            case "say":
                cell.say(message.get("consent"), message.get("estop"))
            case "restore":
                setpoints = unpack_setpoints(message["setpoints"])
                cell.restore(np.array(message["physics"]), setpoints)
            case "break_drive":
                cell.break_drive(message["joint"], message["kind"])
            case "cause" if self._front is not None:
                self._front.cause(message["fault"], message["arm"], message["is_on"])
            case "active_object" | "heard" | "look":
                pass
            case "stop":
                cell.disable()
                self._stopped = True
            case _:
                raise DriverError(f"unknown request {verb!r}")

    def _stop(self, client: LineSocket, verb: str) -> None:
        """What a client that does not control may ask for."""
        now = self.clock.now()
        if verb == "state":
            client.offer({"state": pack_state(self.cell.state(now)), "stopped_s": self._stopped_s})
        elif verb in STOPS:
            STOPS[verb](self.cell)
            self._stopped_s.setdefault(verb, now)
        else:
            raise DriverError(f"this handle may only look, {' and '.join(STOPS)}")

    def _is_to_be_told(self) -> bool:
        """Whether the controlling client is to hear of this period."""
        now = self.clock.now()
        if self._front is not None and now - self._told_s < LOOKED_AT_S:
            return False
        self._told_s = now
        return True

    def _publish(self, client: LineSocket) -> None:
        now = self.clock.now()
        state, scene = self.cell.state(now), self.cell.scene(now)
        message = {"state": pack_state(state), "scene": pack_scene(scene)}
        try:
            client.offer(message)
        except DriverError:
            self._drop(client)


def main() -> None:
    """Entry point of the process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cell", required=True)
    parser.add_argument("--socket", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--options", default="{}", help="WorldOptions, as JSON")
    args = parser.parse_args()
    options = TypeAdapter(WorldOptions).validate_json(args.options)
    world = World(load_cell(args.cell), options, args.seed)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(args.socket))
        args.socket.chmod(0o600)
        listener.listen()
        realtime.prepare()  # a robot's controller would not wait for other programs either
        LoopbackServer(world, listener).run()


if __name__ == "__main__":
    main()
