"""The loopback's cell on the wire as dVRK arms: any CRTK program can be tried on it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import ArmState, CellState
from viskill_deploy.drivers.base import ENABLED, PAUSED
from viskill_deploy.drivers.crtk.arm_on_wire import ArmOnWire
from viskill_deploy.drivers.crtk.console_on_wire import ConsoleOnWire
from viskill_deploy.drivers.crtk.faults import cause
from viskill_deploy.drivers.crtk.kinematics_services import KinematicsServices
from viskill_deploy.drivers.crtk.on_the_way import Arrivals
from viskill_deploy.drivers.crtk.scene_on_wire import SceneOnWire
from viskill_deploy.drivers.crtk.server_options import ServerOptions
from viskill_deploy.drivers.crtk.simulated_arm import Event, SimulatedArm
from viskill_deploy.drivers.crtk.tips_on_wire import TipsOnWire
from viskill_deploy.drivers.crtk.transport import Transport
from viskill_deploy.drivers.loopback_cell import LoopbackCell
from viskill_deploy.drivers.loopback_server import Line
from viskill_deploy.sim.tracker import SimulatedTracker

__all__ = ["CrtkCell", "ServerOptions"]


def _nobody(arm: str, event: Event) -> None:
    """Nobody looks on."""


class CrtkCell:
    """A transport in front of a simulated cell. Arms are independent of each other.

    Messages may arrive in other threads; they are acted upon in `poll` and `advance` only.

    Args:
        cell: the arms as they are; from now on commanded by this object alone.
        transport: where they are to be found; closed by `close`.
        options: version, homing, rates, which arms.
        tell: called with every event of an arm.

    Attributes:
        arms: those on the wire, by name.
        arrivals: setpoints of joints that were heard by any of them.

    Raises:
        DriverError: the cell has no such arm.
    """

    lines: Sequence[Line] = ()
    """A transport waits in a thread of its own."""

    def __init__(
        self,
        cell: LoopbackCell,
        transport: Transport,
        options: ServerOptions | None = None,
        tell: Callable[[str, Event], None] = _nobody,
    ) -> None:
        options = options or ServerOptions()
        self.cell, self._transport = cell, transport
        cell.enable()
        cell.home()
        names = [arm.name for arm in cell.world.cell.arms]
        if not set(options.arms) <= set(names):
            raise DriverError(f"this cell has the arms {', '.join(names)}; choose among them")
        self._held, self._placements = list(cell.setpoints), cell.placements
        self._known = CellState((), cell.inputs(0.0))  # nothing was measured yet
        self.arms: dict[str, ArmOnWire] = {}
        self.arrivals = Arrivals()
        for arm, held in zip(cell.world.cell.arms, self._held, strict=True):
            if arm.name in options.arms or not options.arms:
                simulated = SimulatedArm(arm, held, options)
                self.arms[arm.name] = ArmOnWire(simulated, transport, options, tell, self.arrivals)
                KinematicsServices(arm).serve(transport)
        simulated_arms = {name: arm.arm for name, arm in self.arms.items()}
        self._console = ConsoleOnWire(cell, simulated_arms, transport, options)
        self._scene = SceneOnWire(cell, transport, options.scene_hz)
        self._tips: TipsOnWire | None = None
        if options.tracker is not None:
            tracker = SimulatedTracker(cell.world, options.tracker, options.seed)
            self._tips = TipsOnWire(tracker, names, transport, options.scene_hz)

    def poll(self, now: float) -> None:
        """Hears and answers; no time passes."""
        self._console.poll()
        for arm, state in self._pairs():
            arm.poll()
            arm.speak(state, now)

    def advance(self, now: float) -> None:
        """One control period of arms and physics, which ends at `now`."""
        self._follow_people(now)
        self._console.poll()
        has_supply = not self.cell.inputs(now).estop
        period_s = self.cell.world.options.period_s
        for index, state in enumerate(self._known.arms):
            arm = self.arms.get(state.name)
            if arm is not None:
                self._held[index] = arm.tick(period_s, state, has_supply)
        self.cell.servo_jp(self._held)
        self.cell.advance()
        self._known = self.cell.state(now)
        for arm, state in self._pairs():
            arm.speak(state, now)
        self._scene.speak(now)
        if self._tips is not None:
            self._tips.speak(now)

    def cause(self, fault: str, arm: str, is_on: bool) -> None:
        """Begins or ends a fault of `faults.Fault` on an arm.

        Raises:
            DriverError: there is no such fault or arm.
        """
        if arm not in self.arms:
            raise DriverError(f"no arm {arm!r} here; there are {', '.join(self.arms)}")
        cause(self.arms[arm], fault, is_on)

    def heard(self) -> dict[str, Any]:
        """What has arrived of setpoints, for figures."""
        return self.arrivals.facts()

    def close(self) -> None:
        """Leaves the transport."""
        self._transport.close()

    def _pairs(self) -> list[tuple[ArmOnWire, ArmState]]:
        arms, states = self.arms, self._known.arms
        return [(arms[state.name], state) for state in states if state.name in arms]

    def _follow_people(self, now: float) -> None:
        """Who has a way of his own to the cell may stop it, or put it elsewhere."""
        state = self.cell.operating_state
        if state != ENABLED:
            for arm in self.arms.values():
                arm.arm.state_command("pause" if state == PAUSED else "disable")
            self.cell.enable()
        if self.cell.placements != self._placements or not self._known.arms:
            self._placements, self._held = self.cell.placements, list(self.cell.setpoints)
            self._known = self.cell.state(now)
            for known, held in zip(self._known.arms, self._held, strict=True):
                if known.name in self.arms:
                    self.arms[known.name].arm.place(held)
