"""The simulated console: the operator's pedal, and power for the whole system."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from viskill_deploy.drivers.base import DISABLED, ENABLED
from viskill_deploy.drivers.crtk.messages import Header, Joy, Time
from viskill_deploy.drivers.crtk.operating import FAULT
from viskill_deploy.drivers.crtk.server_options import ServerOptions
from viskill_deploy.drivers.crtk.simulated_arm import SimulatedArm
from viskill_deploy.drivers.crtk.topics import CONSOLE, named
from viskill_deploy.drivers.crtk.transport import Transport
from viskill_deploy.drivers.loopback_cell import LoopbackCell

PRESSED = 1


class ConsoleOnWire:
    """Topics of console and system.

    Args:
        cell: whose simulated operator presses the pedal.
        arms: those on the wire.
        transport: where it is published.
        options: version.
    """

    def __init__(
        self,
        cell: LoopbackCell,
        arms: Mapping[str, SimulatedArm],
        transport: Transport,
        options: ServerOptions,
    ) -> None:
        self._cell, self._arms, self._transport = cell, arms, transport
        self._inbox: deque[tuple[str, Any]] = deque()
        self._publish: dict[str, Callable[[Any], None]] = {}
        self._buttons = {"operator_present": False, "clutch": False}
        self._told: dict[str, bool] = {}
        self._to_home: set[str] = set()
        for topic in CONSOLE:
            name = "/" + named(topic, options.version)
            if topic.publisher == "server":
                publish = transport.publisher(name, topic.message, topic.is_latched)
                self._publish[topic.name.removeprefix("console/")] = publish
            else:
                transport.subscribe(name, topic.message, partial(self._hear, topic.name))

    def poll(self) -> None:
        """Acts on what has been heard, and says what has changed."""
        while self._inbox:
            self._act(*self._inbox.popleft())
        self._buttons["operator_present"] = self._cell.inputs(0.0).consent
        for button, is_pressed in self._buttons.items():
            if self._told.get(button) != is_pressed:
                header = Header(Time.of_ns(self._transport.stamp_ns()))
                self._publish[button](Joy(header, (), (int(is_pressed),)))
                self._told[button] = is_pressed
        for name in tuple(self._to_home):
            self._home(name)

    def _hear(self, topic: str, message: Any, received_s: float) -> None:
        del received_s
        self._inbox.append((topic, message))

    def _act(self, topic: str, message: Any) -> None:
        match topic:
            case "console/emulate_operator_present":
                self._cell.say(consent=message.buttons[:1] == (PRESSED,))
            case "console/emulate_clutch":
                self._buttons["clutch"] = message.buttons[:1] == (PRESSED,)
            case "system/power_on":
                self._power_on()
            case "system/power_off":
                self._to_home.clear()
                for arm in self._arms.values():
                    arm.state_command("disable")
            case "system/home":
                self._power_on()
                self._to_home.update(self._arms)

    def _power_on(self) -> None:
        for arm in self._arms.values():
            if arm.operating.state == FAULT:
                arm.state_command("disable")
            if arm.operating.state == DISABLED:
                arm.state_command("enable")

    def _home(self, name: str) -> None:
        """Homes an arm once it has power; one that has none and gets none is let be."""
        operating = self._arms[name].operating
        if operating.state == DISABLED and operating.phase == "powering":
            return
        self._to_home.discard(name)
        if operating.state == ENABLED:
            self._arms[name].state_command("home")
