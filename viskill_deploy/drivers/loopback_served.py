"""Client side of the served loopback: the driver, which brings server and watchdog along."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path

from viskill_deploy.core.clock import Clock, MonotonicClock
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import ActiveObject, CellState, FloatArray, JointSetpoint, Scene
from viskill_deploy.drivers.base import Capabilities, Driver, accepted
from viskill_deploy.drivers.loopback_stop import connected
from viskill_deploy.drivers.loopback_wire import (
    LineSocket,
    Message,
    pack_scene,
    pack_setpoints,
    unpack_object,
    unpack_scene,
    unpack_state,
)
from viskill_deploy.drivers.watch import WatchProcess
from viskill_deploy.safety.checked import CheckedSetpoint
from viskill_deploy.sim.world import WorldOptions

SERVER = "viskill_deploy.drivers.loopback_server"
ANSWER_TIMEOUT_S = 5.0
POLL_S = 0.0005


class ServedLoopback:
    """The simulated cell in a process of its own, in real time.

    Args:
        cell: the cell; the server loads its file.
        options: period, noise, delay and what else is not perfect.
        seed: of noise, offsets and losses.
        server: the program of the process.
        arguments: what else it is told.
        is_watched: a watchdog stands by; drives on CAN bring their own.

    Attributes:
        path: the server's socket, for a `StopHandle`.
        process: the server.
    """

    capabilities = Capabilities(simulated=True, stepped=False, resettable=True, sees_scene=True)

    def __init__(
        self,
        cell: CellDescription,
        options: WorldOptions | None = None,
        seed: int = 0,
        server: str = SERVER,
        arguments: Sequence[str] = (),
        is_watched: bool = True,
    ) -> None:
        self._command = [sys.executable, "-P", "-m", server, *arguments]
        self._is_watched = is_watched
        self.clock: Clock = MonotonicClock()
        self._options = options or WorldOptions()
        self.period_s, self._cell, self._seed = self._options.period_s, cell, seed
        self._folder = tempfile.TemporaryDirectory(prefix="viskill-")
        self.path = Path(self._folder.name) / "loopback.sock"
        self.process: subprocess.Popen[bytes] | None = None
        self._line: LineSocket | None = None
        self._watch: WatchProcess | None = None
        self._state: Message = {}  # the newest of each, read when somebody asks
        self._scene: Message = {}
        self._seen: Scene | None = None  # what the newest scene says, once somebody has asked
        self._requests = 0
        self._answers: dict[int, Message] = {}

    def connect(self) -> None:
        """Starts the server and its watchdog, and waits for the first word of each.

        Raises:
            DriverError: one of them did not come up in time.
        """
        cell = (self._cell.filed or self._cell).files[0]  # no calibration moves a real arm
        command = [*self._command, "--cell", str(cell), "--socket", str(self.path)]
        command += ["--seed", str(self._seed)]
        command += ["--options", json.dumps(asdict(self._options))]
        # a session of its own: Ctrl-C in the terminal is for the runtime, which needs the robot
        self.process = subprocess.Popen(command, start_new_session=True)
        try:
            self._line = LineSocket(connected(self.path, self.clock))
            self._wait(lambda: bool(self._state), "first state")
            if self._is_watched:
                module = "viskill_deploy.drivers.loopback_watchdog"
                self._watch = WatchProcess(module, [str(self.path)])
        except DriverError:
            self.close()
            raise

    @property
    def watch(self) -> WatchProcess:
        """The watchdog; there is no connection without one."""
        if self._watch is None:
            raise DriverError("the loopback is not connected; call connect() first")
        return self._watch

    def enable(self) -> None:
        """Every arm ENABLED."""
        self._ask({"do": "enable"})

    def home(self) -> None:
        """Every arm homed where it is."""
        self._ask({"do": "home"})

    def hold(self) -> None:
        """Every arm stays at its setpoint."""
        self._ask({"do": "hold"})

    def disable(self) -> None:
        """Every arm DISABLED."""
        self._ask({"do": "disable"})

    def close(self) -> None:
        """Stops the server and closes the connection."""
        if self._line is not None:
            with contextlib.suppress(DriverError):  # it is gone already, and gone arms hold
                self._line.send({"do": "stop"})
            self._line.close()
            self._line = None
        if self._watch is not None:
            self._watch.close()
            self._watch = None
        if self.process is not None:
            try:
                self.process.wait(timeout=ANSWER_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
            self.process = None
        self._folder.cleanup()

    def say(self, consent: bool | None = None, estop: bool | None = None) -> None:
        """What the simulated operator does."""
        self._ask({"do": "say", "consent": consent, "estop": estop})

    def state(self) -> CellState:
        """The newest measurement that has arrived."""
        self._drain()
        state = unpack_state(self._state)
        return replace(state, inputs=self.watch.told(state.inputs, self.clock.now()))

    def truth(self) -> CellState:
        """Where the arms are now, as the simulator has it; the scene is as new from then on."""
        self._ask({"do": "look"})
        return unpack_state(self._state)

    def servo_jp(self, setpoints: Sequence[CheckedSetpoint]) -> None:
        """Sends one checked setpoint an arm."""
        rows = pack_setpoints(accepted(setpoints))
        self._connected_line().send({"do": "servo_jp", "setpoints": rows})

    def scene(self) -> Scene | None:
        """The objects as last seen."""
        self._drain()
        if self._seen is None and self._scene:
            self._seen = unpack_scene(self._scene)
        return self._seen

    def reset(self, layout: Scene) -> None:
        """Puts objects where `layout` says and the arms in their start pose."""
        self._ask({"do": "reset", "scene": pack_scene(layout)})
        self._scene, self._seen = {}, None
        self._wait(lambda: bool(self._scene), "scene after the reset")

    def active_object(self) -> ActiveObject:
        """The truth about the active object, for judging success."""
        return unpack_object(self._ask({"do": "active_object"})["object"])

    def restore(self, physics: FloatArray, setpoints: Sequence[JointSetpoint]) -> None:
        """Goes to a saved moment of the scene that `reset` has set up, at rest."""
        rows = pack_setpoints(list(setpoints))
        self._ask({"do": "restore", "physics": physics.tolist(), "setpoints": rows})

    def break_drive(self, joint: str, kind: str) -> None:
        """A joint's drive breaks; for tests of what happens then."""
        self._ask({"do": "break_drive", "joint": joint, "kind": kind})

    def cause(self, fault: str, arm: str, is_on: bool = True) -> None:
        """Begins or ends a fault of what stands in front of the cell, such as a dVRK's."""
        self._ask({"do": "cause", "fault": fault, "arm": arm, "is_on": is_on})

    def heard(self) -> Message:
        """What has arrived of setpoints over another way, for figures; {} where nobody counts."""
        return dict(self._ask({"do": "heard"}).get("heard", {}))

    def _connected_line(self) -> LineSocket:
        if self._line is None:
            raise DriverError("the loopback is not connected; call connect() first")
        return self._line

    def _drain(self) -> None:
        refusal = ""
        for message in self._connected_line().receive():
            if "state" in message:
                self._state = message["state"]
            if "scene" in message:
                self._scene, self._seen = message["scene"], None
            if message.get("id") is not None:
                self._answers[message["id"]] = message
            elif "error" in message:
                refusal = str(message["error"])
        if refusal:
            raise DriverError(f"the loopback refused: {refusal}")

    def _ask(self, request: Message) -> Message:
        self._requests += 1
        key = self._requests
        self._connected_line().send(request | {"id": key})
        self._wait(lambda: key in self._answers, f"answer to {request['do']}")
        answer = self._answers.pop(key)
        if "error" in answer:
            raise DriverError(f"the loopback refused: {answer['error']}")
        return answer

    def _wait(self, arrived: Callable[[], bool], what: str) -> None:
        deadline = self.clock.now() + ANSWER_TIMEOUT_S
        while True:
            self._drain()
            if arrived():
                return
            if self.clock.now() > deadline:
                raise DriverError(f"the loopback gave no {what} within {ANSWER_TIMEOUT_S} s")
            self.clock.sleep_until(self.clock.now() + POLL_S)


def connect(cell: CellDescription, options: WorldOptions | None = None, seed: int = 0) -> Driver:
    """A connected served loopback."""
    driver = ServedLoopback(cell, options, seed)
    driver.connect()
    return driver
