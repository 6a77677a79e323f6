"""Following a plan file on a cell: prepared like a bundle, checked whole, then streamed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from viskill_deploy.core import data
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import Waypoint
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.moves import axes_of, stream
from viskill_deploy.runtime.session import Session
from viskill_deploy.runtime.trajectory import open_plan, plan_waypoints
from viskill_deploy.sim.tasks.base import Task, load_task, task_names

PLAN_ENDING = ".plan.json"


@dataclass(frozen=True)
class PreparedTrajectory:
    """A plan file and its cell, held against each other; stands where a `Prepared` stands.

    Attributes:
        task: whose things lie about; None for a cell without a task.
        waypoints: as in the file.
        files: path and SHA-256 of every data file that the run uses.
        notes: what people should know.
    """

    name: str
    task: Task | None
    cell: CellDescription
    waypoints: tuple[Waypoint, ...]
    files: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]

    @property
    def distributions(self) -> Sequence[str]:
        """Where layouts can be drawn from."""
        return self.task.distributions if self.task else ()

    def about(self) -> dict[str, Any]:
        """What a run's figures say of it."""
        return {
            "task": self.task.name if self.task else self.cell.name,
            "bundle": self.name,
            "subgoals": "trajectory",
            "subgoal_layout": [],
            "value_threshold": None,
            "value_meaning": None,
        }


def prepare_trajectory(path: Path, cell_name: str = "") -> PreparedTrajectory:
    """A plan file, if the cell that it was made for is here.

    Args:
        path: the plan file.
        cell_name: name or file of the cell; by default the plan's, in `robots/cells`.

    Raises:
        DataFileError: the plan, or a file of the cell, is wrong; or it is another cell.
        MotionError: a waypoint lies outside the workspace of its arm.
    """
    cell, waypoints = open_plan(path, cell_name)
    task = load_task(cell.name, cell) if cell.name in task_names() else None
    notes = [
        "success means that the trajectory was followed to its end, not that a task was done",
        *(
            f"{file} stands in front of the packaged {hidden}"
            for file in cell.files
            if (hidden := data.shadows(file)) is not None
        ),
    ]
    files = data.digests((*cell.files, path))
    name = path.name.removesuffix(PLAN_ENDING)
    return PreparedTrajectory(name, task, cell, tuple(waypoints), files, tuple(notes))


def followed(session: Session, waypoints: Sequence[Waypoint], episode: int) -> EpisodeResult:
    """Plans from where the arms are, puts the whole plan before a gate, and only then streams it.

    Raises:
        MotionError: the plan cannot be made.
        SafetyStop: the gate would step in; nothing has moved.
    """
    result, state = EpisodeResult(episode), session.make_ready()
    plan = plan_waypoints(session.cell, waypoints, axes_of(state))
    session.check(plan, state)
    session.begin()
    session.recorder.mark(session.driver.clock.now(), episode, "trajectory", 0)
    if not stream(session, plan):
        session.come_to_rest(result)
        return result
    session.finish()
    result.stopped_by = session.cause
    result.success = not result.stopped_by
    return result
