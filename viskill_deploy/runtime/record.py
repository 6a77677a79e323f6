"""What a session tells the record of its run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from viskill_deploy.core.types import (
    Action,
    Boundary,
    CellState,
    FloatArray,
    JointSetpoint,
    Mode,
    Request,
    Scene,
    SkillStart,
    Verdict,
)


class Recorder(Protocol):
    """Where every cycle leaves its record (S32); `observe.recording` has the real one."""

    @property
    def alive(self) -> bool:
        """Whether the record is being kept."""
        ...

    @property
    def process_id(self) -> int:
        """The process that writes it."""
        ...

    def cycle(
        self,
        now: float,
        state: CellState,
        request: Request,
        sent: Sequence[JointSetpoint],
        action: Action,
        verdicts: Sequence[Verdict],
        mode: Mode,
        tip_poses: Sequence[FloatArray] | None,
    ) -> None:
        """Records one control cycle."""
        ...

    def scene(self, now: float, scene: Scene) -> None:
        """Records the objects."""
        ...

    def mark(
        self,
        now: float,
        episode: int,
        skill: str,
        step: int,
        note: str = "",
        start: SkillStart | None = None,
        boundary: Boundary | None = None,
    ) -> None:
        """Records where in the run this is, and with a skill's first step what was decided there.

        An episode's first note names its active object. A `boundary` stands by itself, before the
        first step of the skill that it lets begin.
        """
        ...


class NoRecord:
    """A record that nobody keeps: for studies of thousands of simulated runs, never for arms."""

    alive = True
    process_id = 0

    def cycle(self, *values: object) -> None:
        """Keeps nothing."""

    def scene(self, *values: object) -> None:
        """Keeps nothing."""

    def mark(self, *values: object, **named: object) -> None:
        """Keeps nothing."""
