"""A loopback whose active thing is knocked out of the jaw at some moment, and runs on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from viskill_deploy.core.types import Boundary, FloatArray, Scene
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.runtime.boundaries import Job
from viskill_deploy.runtime.episodes import from_start_pose
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.session import Session


class KnockingDriver(LoopbackDriver):
    """Knocks once, at the first period in which `when` says so, by what it says."""

    when: Callable[[KnockingDriver], FloatArray | None] | None = None

    def advance(self) -> None:
        super().advance()
        if self.when is not None:
            way = self.when(self)
            if way is not None:
                self.when = None
                self.world.knock(way)


@dataclass
class Notes:
    """A recorder that keeps the boundaries."""

    alive: bool = True
    boundaries: list[Boundary] = field(default_factory=list)
    sent: list[tuple[float, ...]] = field(default_factory=list)

    def cycle(self, *args: object) -> None:
        self.sent.append(tuple(x for s in args[3] for x in (*s.jp, s.jaw)))  # type: ignore[attr-defined]

    def scene(self, *args: object) -> None:
        pass

    def mark(self, *args: object, boundary: Boundary | None = None, **more: object) -> None:
        if boundary is not None:
            self.boundaries.append(boundary)


def knocked(
    job: Job,
    layout: Scene,
    when: Callable[[KnockingDriver], FloatArray | None],
    is_planned: bool = False,
    notes: Notes | None = None,
) -> tuple[EpisodeResult, Notes, Session]:
    """An episode in which the active thing is knocked away."""
    driver, notes, cell = KnockingDriver(job.task.cell), notes or Notes(), job.task.cell
    driver.connect()
    driver.reset(layout)
    driver.when = when
    training = job.bundle.manifest.training_range.seen
    with Session(cell, driver, Line(cell, driver.period_s), notes, training) as session:
        mode, dice = "plan" if is_planned else "closed-loop", np.random.default_rng(0)
        result = from_start_pose(session, mode, job, dice, 0)
        session.ledger.end_episode(result)
        return result, notes, session


def lifted(arm: int, height_m: float) -> Callable[[KnockingDriver], bool]:
    """Whether an arm alone holds the active thing, this high above where it was."""
    first: list[float] = []

    def is_lifted(driver: KnockingDriver) -> bool:
        thing = driver.world.active_object()
        first.append(thing.T_task_object[2, 3])
        alone = thing.touched[arm] and sum(thing.touched) == 1
        return alone and thing.T_task_object[2, 3] - first[0] > height_m

    return is_lifted
