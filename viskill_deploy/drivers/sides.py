"""The side of a simulated cell that no robot has: its operator, its objects, its broken drives.

Drivers that reach their arms over a bus or a network take this way for what is not said there.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from viskill_deploy.core.clock import Clock
from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import ActiveObject, CellState, Scene
from viskill_deploy.drivers.loopback_cell import LoopbackCell

SIMULATED = "simulated"
"""Source of the consent that a simulated operator gives."""


class Side(Protocol):
    """What a simulated cell does that no robot can be told."""

    def say(self, consent: bool | None = None, estop: bool | None = None) -> None:
        """What the simulated operator does."""
        ...

    def scene(self) -> Scene | None:
        """Where the objects are."""
        ...

    def break_drive(self, joint: str, kind: str) -> None:
        """Breaks a joint's drive, or mends all."""
        ...

    def active_object(self) -> ActiveObject:
        """The truth about the active object."""
        ...

    def reset(self, layout: Scene) -> None:
        """Puts arms and objects in place."""
        ...

    def truth(self) -> CellState:
        """Where the arms really are, as one sees who looks at them."""
        ...

    def close(self) -> None:
        """Ends the simulation."""
        ...


class SteppedSide:
    """The simulated cell in this process.

    Args:
        cell: the cell.
        clock: its time.
        let_go: ends what stands between it and the driver.
    """

    def __init__(self, cell: LoopbackCell, clock: Clock, let_go: Callable[[], None]) -> None:
        self._cell, self._clock, self._let_go = cell, clock, let_go
        self._is_open = True

    def say(self, consent: bool | None = None, estop: bool | None = None) -> None:
        """What the simulated operator does."""
        self._opened()
        self._cell.say(consent, estop)

    def scene(self) -> Scene:
        """The objects as the simulator knows them."""
        self._opened()
        return self._cell.scene(self._clock.now())

    def break_drive(self, joint: str, kind: str) -> None:
        """A joint's drive breaks."""
        self._cell.break_drive(joint, kind)

    def active_object(self) -> ActiveObject:
        """The truth about the active object."""
        return self._cell.world.active_object()

    def reset(self, layout: Scene) -> None:
        """Puts objects and arms in place."""
        self._cell.reset(layout)

    def truth(self) -> CellState:
        """Where the arms really are."""
        return self._cell.state(self._clock.now())

    def close(self) -> None:
        """Ends the simulation; may be called twice."""
        if self._is_open:
            self._let_go()
        self._is_open = False

    def _opened(self) -> None:
        if not self._is_open:
            raise DriverError("the simulated cell is closed; make another one")


class WithSide:
    """The part of a driver of a simulated cell that goes by its side.

    Attributes:
        side: that way.
    """

    side: Side

    def say(self, consent: bool | None = None, estop: bool | None = None) -> None:
        """What the simulated operator does; its console or node says it."""
        self.side.say(consent, estop)

    def scene(self) -> Scene | None:
        """The objects as the simulator knows them."""
        return self.side.scene()

    def break_drive(self, joint: str, kind: str) -> None:
        """A joint's drive breaks."""
        self.side.break_drive(joint, kind)

    def active_object(self) -> ActiveObject:
        """The truth about the active object, for judging success."""
        return self.side.active_object()
