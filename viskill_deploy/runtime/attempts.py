"""What an episode runs, and how it is tried again: planned anew from where the arms are now."""

from __future__ import annotations

import numpy as np

from viskill_deploy.bundle.subgoals import KeptSubgoals, SubgoalSource, subgoal_source
from viskill_deploy.core.errors import DriverError, SafetyStop, ViskillError
from viskill_deploy.core.types import Boundary, CellState, Scene
from viskill_deploy.runtime.boundaries import Job, held_now, leave
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.moves import axes_of, go_to_start_pose
from viskill_deploy.runtime.planning import Plan, make_plan
from viskill_deploy.runtime.session import Session


def scene_of(session: Session) -> Scene:
    """Where the things are; raises DriverError where nothing tells."""
    scene = session.driver.scene()
    if scene is None:
        raise DriverError("nothing says where the objects are; give a scene")
    return scene


class Attempts:
    """The attempts of one episode.

    Every attempt after the first begins where things may lie as in no training run. So it is done
    in a simulator first, from the measured pose, and the plan is put before a gate that lets
    nothing out. Only what succeeds there is tried, in closed loop too.

    Args:
        session: the arms.
        job: what to do.
        rng: for the scripted plan's subgoals.

    Attributes:
        subgoals: who gives the subgoals of the present attempt.
    """

    def __init__(self, session: Session, job: Job, rng: np.random.Generator) -> None:
        self._session, self._job, self._rng = session, job, rng
        self.subgoals: SubgoalSource = subgoal_source(job.bundle, job.task, rng)

    def plan(self, state: CellState, scene: Scene, first: str = "") -> Plan:
        """A plan from where the arms are, put before a gate that lets nothing out; moves nothing.

        Args:
            state: where the arms are.
            scene: where the things are.
            first: name of the skill to begin with; the task's first by default.

        Raises:
            MotionError, KinematicsError: there is none, or it does not do the task.
            SafetyStop: the gate would step in.
        """
        session, job, held = self._session, self._job, axes_of(state)
        measured = held.copy()
        measured[:, :6] = [arm.measured_jp for arm in state.arms]
        measured[:, 6] = [arm.jaw_measured_jp for arm in state.arms]
        plan = make_plan(
            session.cell,
            job.task,
            job.bundle,
            measured,
            held,
            scene,
            self._rng,
            self.subgoals,
            first,
        )
        session.check(plan, state)
        return plan

    def again(self, boundary: Boundary, result: EpisodeResult) -> Plan | None:
        """After a boundary at which the runtime does not go on: the next attempt's plan.

        While it is made the arms rest and the gate is disarmed: a new attempt is a new motion, and
        needs the operator's consent like the first.

        Returns:
            None when there is no next attempt: the arms are in their start pose then, or under
            the gate's stop, and `result` says why.
        """
        session = self._session
        if not leave(session, boundary):
            session.come_to_rest(result)
            return None
        if boundary.course != "retry":
            return None
        held = held_now(session)
        source: SubgoalSource = subgoal_source(self._job.bundle, self._job.task, self._rng)
        if any(held):  # the skill goes on with what it has; it is told the same
            source = KeptSubgoals(self.subgoals, [skill.start for skill in result.skills])
        self.subgoals, plan = source, None
        session.finish()
        if session.cause:
            result.stopped_by = session.cause
            return None
        try:
            plan = self.plan(session.read(), scene_of(session), boundary.skill)
        except (ViskillError, ValueError) as error:
            result.reason = f"not tried again: {error}"
        try:
            session.begin()
        except SafetyStop as error:
            result.reason = f"not tried again: {error}"
            return None
        if plan is not None:
            result.retries += 1
        elif not go_to_start_pose(session, held):
            session.come_to_rest(result)
        return plan
