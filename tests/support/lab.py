"""A lab for `viskill execute`: dVRK arms that are taken for real ones, their files, and a person.

The arms are simulated, in a process of their own. The person has a foot on the console's pedal.
"""

from __future__ import annotations

import atexit
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from calibrations import write_fresh
from lab_files import SCENE, with_serials
from operators import Person
from silent_recorder import SilentRecorder

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.scene_files import read_scene
from viskill_deploy.core.types import JointSetpoint
from viskill_deploy.drivers.crtk.messages import Header, Joy, Time
from viskill_deploy.drivers.crtk.opening import LOOPBACK, open_transport
from viskill_deploy.drivers.crtk.private_network import PrivateNetwork
from viskill_deploy.drivers.crtk.server_options import Homing, ServerOptions
from viskill_deploy.drivers.crtk.simulated import served_arms
from viskill_deploy.runtime.consent import LET_GO, PRESS
from viskill_deploy.runtime.execution import ExecuteOptions, execute, look_before
from viskill_deploy.runtime.figures import Outcome
from viskill_deploy.runtime.poses import PoseLimits
from viskill_deploy.runtime.preflight import Sources, prepare
from viskill_deploy.runtime.robots import RobotOptions, connected, things_of
from viskill_deploy.sim.world import WorldOptions

ROOT = Path(__file__).resolve().parents[2]
BUNDLE = ROOT / "policies/bipegtransfer-viskill"
CELL = "bipegtransfer"
PEDAL = "/console/emulate_operator_present"
TRACKER = "/scene/{object}/measured_cp"
PATIENCE_S = 10.0


class Kept(SilentRecorder):
    """Keeps what the gate let out, and lets things happen in time.

    Attributes:
        passed: setpoints of all arms, cycle by cycle.
        events: what happens once so many cycles of the policy's motion have gone out.
    """

    def __init__(self, events: dict[int, Any] | None = None) -> None:
        self.passed: list[tuple[JointSetpoint, ...]] = []
        self.events, self._began = events or {}, -1

    def cycle(self, *record: Any) -> None:
        self.passed.append(record[3])
        since = len(self.passed) - self._began
        if self._began >= 0 and since in self.events:
            self.events.pop(since)()

    def mark(self, *record: Any, **named: Any) -> None:
        self._began = len(self.passed) if self._began < 0 else self._began


@cache
def _master() -> PrivateNetwork:
    """The ROS 1 master of all labs: a process belongs to one master as long as it lives."""
    private = PrivateNetwork("ros1")
    atexit.register(private.close)
    return private


class Lab:
    """Arms, files and pedal.

    Args:
        folder: for the files.
        transport: what the arms speak.
        homing: where they go when they are homed.

    Attributes:
        server: the arms' process, and its private socket.
        network: where they are.
    """

    def __init__(self, folder: Path, transport: str, homing: Homing = "stay") -> None:
        self.transport, self._stack = transport, ExitStack()
        self.robot, self.scene = folder / "lab.toml", folder / "scene.toml"
        self.robot.write_text(with_serials(CELL), encoding="utf-8")
        self.scene.write_text(SCENE, encoding="utf-8")
        cell = load_cell(str(self.robot))
        self.calibration = write_fresh(folder / "lab.json", cell)
        private = _master() if transport == "ros1" else PrivateNetwork(transport)
        if transport != "ros1":
            self._stack.callback(private.close)
        self.network, options = private.network, ServerOptions(homing=homing)
        self.server = served_arms(cell, transport, self.network, WorldOptions(), 0, options)
        self._stack.callback(self.server.close)
        self.server.connect()
        self.put_things_back()
        node = open_transport(transport, self.network)
        self._stack.callback(node.close)
        say = node.publisher(PEDAL, Joy)
        self.say = lambda pressed: say(
            Joy(Header(Time.of_ns(node.stamp_ns())), (), (int(pressed),))
        )

    def put_things_back(self) -> None:
        """The things where the scene file has them, and the arms in their start pose."""
        self.server.reset(read_scene(self.scene, CELL).scene)

    def press(self, is_pressed: bool) -> None:
        """The pedal, until it is seen to be so."""
        deadline = time.monotonic() + PATIENCE_S
        while self.server.truth().inputs.consent is not is_pressed:
            assert time.monotonic() < deadline, "nobody hears the pedal"
            self.say(is_pressed)
            time.sleep(0.02)

    def close(self) -> None:
        self._stack.close()

    def execute(self, person: Person, recorder: Kept, looks: bool = False, **how: Any) -> Outcome:
        """Runs once; what came of it.

        Args:
            person: at the terminal.
            recorder: what is kept of it.
            looks: makes the whole plan before, as people do.
            how: the options.
        """
        sources = Sources(BUNDLE, str(self.robot), self.calibration, self.scene, time.time())
        prepared = prepare(sources)
        options = ExecuteOptions(**({"speed": 1.0} | how))
        way = RobotOptions("crtk", transport=self.transport, network=self.network)
        found = connected(prepared.cell, way)
        try:
            names = [arm.name for arm in prepared.cell.arms]
            things = things_of(found, way, prepared.scene, TRACKER, PoseLimits(), names)
            if looks:
                look_before(prepared, options, found.driver, things).insist()
            return execute(prepared, options, found.driver, recorder, person, things)
        finally:
            found.close()

    def command(self, folder: Path, *arguments: str) -> list[str]:
        """`viskill execute` at full speed, agreed to."""
        network = ("--domain", str(self.network.domain), "--interface", LOOPBACK)
        files = ("--robot", str(self.robot), "--calibration", str(self.calibration))
        things = ("--scene", str(self.scene), "--pose-topic", TRACKER)
        command = [sys.executable, "-m", "viskill_deploy.cli.main", "execute", str(BUNDLE)]
        command += ["--driver", "crtk", "--transport", self.transport, *network, *files, *things]
        return [
            *command,
            "--speed",
            "1.0",
            "--yes",
            "--no-video",
            "--output",
            str(folder),
            *arguments,
        ]


@contextmanager
def opened(folder: Path, transport: str, homing: Homing = "stay") -> Iterator[Lab]:
    """A lab that is closed afterwards."""
    folder.mkdir(parents=True, exist_ok=True)
    lab = Lab(folder, transport, homing)
    try:
        yield lab
    finally:
        lab.close()


class AtPedal(Person):
    """Steps on the pedal and off it when told to, and goes on until a skill that is not wanted.

    Args:
        lab: whose pedal.
        unwanted: how a question begins that is answered with no.
    """

    def __init__(self, lab: Lab, unwanted: str = "never") -> None:
        super().__init__()
        self._lab, self._unwanted = lab, unwanted

    def tell(self, note: str) -> None:
        super().tell(note)
        if note in {PRESS, LET_GO}:
            self._lab.press(note == PRESS)

    def ask(self, question: str) -> None:
        super().ask(question)
        self.answers = ["n" if question.startswith(self._unwanted) else ""]
        if question.startswith("held"):
            self._lab.say(True)
