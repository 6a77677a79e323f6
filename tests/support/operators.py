"""A person at the terminal of a run, and a simulated cell that notes what it is told."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import CellState, JointSetpoint
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.safety.checked import CheckedSetpoint
from viskill_deploy.sim.world import WorldOptions


@dataclass
class Person:
    """Answers every question with the next of `answers`, and with "" when there is none left.

    Attributes:
        thinks: looks for an answer that find none, each time.
    """

    answers: list[str] = field(default_factory=list)
    thinks: int = 3
    told: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)
    _looks: int = 0

    def tell(self, note: str) -> None:
        self.told.append(note)

    def ask(self, question: str) -> None:
        self.asked.append(question)
        self._looks = 0

    def answer(self) -> str | None:
        self._looks += 1
        if self._looks <= self.thinks:
            return None
        return self.answers.pop(0) if self.answers else ""


class Spied(LoopbackDriver):
    """The stepped loopback at 100 Hz.

    Attributes:
        sent: every setpoint that arrived, one tuple a cycle.
        calls: names of the other commands that arrived.
        events: what happens once a number of setpoints has gone out.
    """

    def __init__(self, cell: CellDescription) -> None:
        super().__init__(cell, WorldOptions(0.01))
        self.sent: list[tuple[JointSetpoint, ...]] = []
        self.calls: list[str] = []
        self.events: list[tuple[int, Callable[[], None]]] = []
        self.readings = 0

    def state(self) -> CellState:
        self.readings += 1
        while self.events and len(self.sent) >= self.events[0][0]:
            self.events.pop(0)[1]()
        return super().state()

    def servo_jp(self, setpoints: Sequence[CheckedSetpoint]) -> None:
        super().servo_jp(setpoints)
        self.sent.append(tuple(s.setpoint for s in setpoints))

    def enable(self) -> None:
        self.calls.append("enable")
        super().enable()

    def home(self) -> None:
        self.calls.append("home")
        super().home()

    def hold(self) -> None:
        self.calls.append("hold")
        super().hold()

    def disable(self) -> None:
        self.calls.append("disable")
        super().disable()

    def close(self) -> None:
        if self._cell is not None:
            self.calls.append("close")
        super().close()
