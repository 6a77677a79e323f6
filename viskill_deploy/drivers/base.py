"""The driver protocol: what every robot behind this package can do, in CRTK's words.

Drivers take setpoints only as `safety.CheckedSetpoint`, which the supervisor alone can make: there
is no second way to move. A driver's file offers `connect(options) -> Driver`; the conformance suite
in `tests/integration/test_driver_conformance.py` holds each of them to the same behaviour.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from viskill_deploy.core.clock import Clock
from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import ActiveObject, CellState, JointSetpoint, Scene
from viskill_deploy.drivers.watch import Watch
from viskill_deploy.safety.checked import CheckedSetpoint

DISABLED, ENABLED, PAUSED = "DISABLED", "ENABLED", "PAUSED"
"""CRTK operating states; FAULT is the other."""


@dataclass(frozen=True, slots=True)
class Capabilities:
    """What a driver is.

    Attributes:
        simulated: no real arm moves.
        stepped: time moves only when its clock is asked to sleep.
        resettable: `reset` puts the arms and objects somewhere.
        sees_scene: `scene` gives object poses.
    """

    simulated: bool
    stepped: bool
    resettable: bool
    sees_scene: bool


class Driver(Protocol):
    """A cell of arms. All calls return at once; time passes in `clock.sleep_until`.

    Every method may raise DriverError, which the runtime turns into a verdict (S24).
    """

    clock: Clock
    period_s: float
    capabilities: Capabilities

    @property
    def watch(self) -> Watch:
        """The watchdog that `connect` has started. No driver works without one."""
        ...

    def connect(self) -> None:
        """Opens the connection; arms stay DISABLED."""
        ...

    def enable(self) -> None:
        """Asks every arm for ENABLED."""
        ...

    def home(self) -> None:
        """Asks every enabled arm to home."""
        ...

    def hold(self) -> None:
        """Every arm stays at the setpoint that it holds."""
        ...

    def disable(self) -> None:
        """Takes power from every arm."""
        ...

    def close(self) -> None:
        """Holds, disables and closes the connection; may be called twice."""
        ...

    def state(self) -> CellState:
        """The newest measurement of every arm, with validity and age, and the inputs."""
        ...

    def servo_jp(self, setpoints: Sequence[CheckedSetpoint]) -> None:
        """Sends one setpoint an arm (joints and jaw), exactly as the supervisor passed it."""
        ...

    def scene(self) -> Scene | None:
        """Where the objects are, if the driver sees them."""
        ...

    def say(self, consent: bool | None = None, estop: bool | None = None) -> None:
        """What the simulated operator does; only where `capabilities.simulated`."""
        ...

    def break_drive(self, joint: str, kind: str) -> None:
        """Breaks a joint's drive ("stuck", "slip") or mends all; only where simulated."""
        ...

    def active_object(self) -> ActiveObject:
        """The truth about the active object; only where `capabilities.simulated`."""
        ...

    def reset(self, layout: Scene) -> None:
        """Puts arms and objects where `layout` says; only where `capabilities.resettable`."""
        ...


def accepted(setpoints: Sequence[CheckedSetpoint]) -> list[JointSetpoint]:
    """The numbers of checked setpoints, in the order of the arms.

    Raises:
        DriverError: something else than the supervisor's setpoints, or not one an arm.
    """
    for setpoint in setpoints:
        if type(setpoint) is not CheckedSetpoint:
            raise DriverError(
                f"servo_jp takes CheckedSetpoint, not {type(setpoint).__name__}; "
                "send what Supervisor.check returns"
            )
    if [s.arm for s in setpoints] != list(range(len(setpoints))):
        raise DriverError("servo_jp needs one setpoint an arm, in the order of the cell")
    return [s.setpoint for s in setpoints]
