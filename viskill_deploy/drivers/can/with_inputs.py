"""Consent and emergency stop from a node on CAN, with any driver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from viskill_deploy.core import data
from viskill_deploy.core.clock import Clock
from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.robot_files import Table, read_toml
from viskill_deploy.core.types import ActiveObject, CellState, Scene
from viskill_deploy.drivers.base import Driver
from viskill_deploy.drivers.can.config import Interface, NodeId
from viskill_deploy.drivers.can.inputs import InputNode
from viskill_deploy.drivers.can.line import CanLine
from viskill_deploy.drivers.watch import Watch
from viskill_deploy.safety.checked import CheckedSetpoint

SOURCE = "CAN input node"
"""How the gate calls who agrees."""

PATIENCE_S = 1.0
"""Time that the node gets to speak for the first time."""


class InputFile(Table):
    """`robots/inputs/<name>.toml`: where a consent and emergency-stop node hangs."""

    schema_version: Literal[1] = Field(alias="schema")
    name: str
    interface: Interface
    channel: str
    node_id: NodeId
    heartbeat_s: Annotated[float, Field(ge=0.01, le=0.5)]


def load_inputs(name: str) -> InputFile:
    """An input file, by its name in `robots/inputs` or its path.

    Raises:
        DataFileError: the file is wrong or missing.
    """
    path = Path(name) if name.endswith(".toml") else data.find(f"robots/inputs/{name}.toml")
    return read_toml(path, InputFile)


class WithInputNode:
    """Hands everything on to a driver; who agrees to motion is the node.

    Either emergency stop counts, the node's and the driver's own; a node that falls silent is one.

    Args:
        driver: a connected driver.
        file: the node.

    Raises:
        DriverError: the bus cannot be opened, or the node says nothing.
    """

    def __init__(self, driver: Driver, file: InputFile) -> None:
        self._driver, self._file = driver, file
        self.clock: Clock = driver.clock
        self.period_s, self.capabilities = driver.period_s, driver.capabilities
        self.node = InputNode(file.node_id, file.heartbeat_s, SOURCE)
        self._line: CanLine | None = None
        self._open()

    @property
    def watch(self) -> Watch:
        """The watchdog of the driver."""
        return self._driver.watch

    def connect(self) -> None:
        """Opens the driver's connection, and the node's bus if it was closed."""
        self._driver.connect()
        if self._line is None:
            self._open()

    def enable(self) -> None:
        """Asks every arm for ENABLED."""
        self._driver.enable()

    def home(self) -> None:
        """Asks every enabled arm to home."""
        self._driver.home()

    def hold(self) -> None:
        """Every arm stays at the setpoint that it holds."""
        self._driver.hold()

    def disable(self) -> None:
        """Takes power from every arm."""
        self._driver.disable()

    def close(self) -> None:
        """Closes the driver, then the node's bus."""
        try:
            self._driver.close()
        finally:
            if self._line is not None:
                self._line.close()
                self._line = None

    def state(self) -> CellState:
        """The driver's newest measurement, with the node's word.

        Raises:
            DriverError: the driver's, or the node's bus is lost.
        """
        state = self._driver.state()
        return replace(state, inputs=self.node.over(state.inputs, self._listen()))

    def servo_jp(self, setpoints: Sequence[CheckedSetpoint]) -> None:
        """Sends one setpoint an arm."""
        self._driver.servo_jp(setpoints)

    def scene(self) -> Scene | None:
        """Where the objects are, if the driver sees them."""
        return self._driver.scene()

    def say(self, consent: bool | None = None, estop: bool | None = None) -> None:
        """The simulated operator's emergency stop counts still; his consent does not."""
        del consent
        self._driver.say(estop=estop)

    def break_drive(self, joint: str, kind: str) -> None:
        """Breaks a joint's drive or mends all."""
        self._driver.break_drive(joint, kind)

    def active_object(self) -> ActiveObject:
        """The truth about the active object."""
        return self._driver.active_object()

    def reset(self, layout: Scene) -> None:
        """Puts arms and objects where `layout` says."""
        self._driver.reset(layout)

    def _open(self) -> None:
        file = self._file
        self._line = CanLine(f"input node {file.node_id}", file.interface, file.channel)
        deadline = self.clock.now() + PATIENCE_S
        while not self.node.has_spoken:
            if self.clock.now() > deadline:
                self._line.close()
                self._line = None
                raise DriverError(
                    f"input node {file.node_id} on {file.interface} {file.channel} says nothing; "
                    "look at its plug, bit rate and node id"
                )
            self.clock.sleep_until(self.clock.now() + self.period_s)
            self._listen()

    def _listen(self) -> float:
        """Hears what the node has said; returns the time."""
        line, now = self._line, self.clock.now()
        if line is None:
            raise DriverError("the input node is not connected; call connect() first")
        for can_id, word in line.drain():
            if can_id == self.node.feedback_id:
                self.node.hear_word(word, now)
            elif can_id == self.node.heartbeat_id:
                self.node.hear_heartbeat(word, now)
        if line.trouble:
            raise DriverError(line.trouble)
        return now
