"""What an episode runs, and how it is tried again: planned anew from where the arms are now."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from viskill_deploy.bundle.subgoals import KeptSubgoals, SubgoalSource, subgoal_source
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DriverError, MotionError, SafetyStop, ViskillError
from viskill_deploy.core.types import Boundary, CellState, Scene
from viskill_deploy.runtime.air import over, start_axes
from viskill_deploy.runtime.boundaries import Job, held_now, leave, way_back
from viskill_deploy.runtime.jaws import SETTLE_S
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.moves import axes_of, go_to_start_pose, halt, rest
from viskill_deploy.runtime.planning import OFF_PLAN_M, Plan, make_plan
from viskill_deploy.runtime.resuming import resumed
from viskill_deploy.runtime.session import Session


def plan_for(
    cell: CellDescription,
    job: Job,
    state: CellState,
    scene: Scene,
    rng: np.random.Generator,
    subgoals: SubgoalSource | None = None,
    first: str = "",
    must_succeed: bool = True,
) -> Plan:
    """The plan of a job from where the arms are; in the air, as it is made on the ground.

    Args:
        cell: the arms in their places, lifted where the job is run in the air.
        job: what to do.
        state: where the arms are.
        scene: where the things are.
        rng: for the scripted plan's subgoals.
        subgoals: who gives the subgoals; by default, what the bundle asks for.
        first: name of the skill to begin with; the task's first by default.
        must_succeed: whether a plan that does not do the task is refused.

    Raises:
        MotionError, KinematicsError: there is none, or it does not do the task.
    """
    held, stops = axes_of(state), job.stops == "waypoint"
    measured = held.copy()
    measured[:, :6] = [arm.measured_jp for arm in state.arms]
    measured[:, 6] = [arm.jaw_measured_jp for arm in state.arms]
    ground = job.ground or cell
    if job.ground is not None:
        measured = start_axes(job.ground, held)
    begin = held if job.ground is None else measured
    plan = make_plan(
        ground, job.task, job.bundle, measured, begin, scene, rng, subgoals, first,
        must_succeed, stops,
    )  # fmt: skip
    return plan if job.ground is None else over(plan, cell, held, stops)


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
        session, job = self._session, self._job
        plan = plan_for(session.cell, job, state, scene, self._rng, self.subgoals, first)
        session.check(plan, state)
        return plan

    def next(self, boundary: Boundary | None, result: EpisodeResult) -> Plan | None:
        """What follows an attempt that has ended.

        Args:
            boundary: at which the runtime did not go on; None where there was none.
            result: the episode so far.

        Returns:
            The next attempt's plan; None when there is none, as `again` and `resumed` say.
        """
        return self.resumed(result) if boundary is None else self.again(boundary, result)

    def resumed(self, result: EpisodeResult) -> Plan | None:
        """After a HOLD: planned anew from where the arms are held, once the operator wants it.

        Returns:
            None where nothing was held, and as `resuming.resumed` says.
        """
        if not result.stopped_by or not result.skills:
            return None
        operator = self._job.operator
        return resumed(self._session, operator, result, lambda: self._replan(result))

    def _replan(self, result: EpisodeResult) -> Callable[[], Plan]:
        """Looks at the arms; what makes a plan from the latest skill that can begin so."""
        session, skills = self._session, self._job.task.skills
        held, names = held_now(session), [skill.name for skill in skills]
        first = way_back(skills, names.index(result.skills[-1].start.skill), held)
        if not first:
            raise MotionError(
                "no skill can begin with what the jaws hold; open them by hand and start again"
            )
        self._choose_subgoals(held, result)
        return partial(self.plan, session.read(), session.scene(), first)

    def _choose_subgoals(self, held: tuple[bool, ...], result: EpisodeResult) -> None:
        """New ones; a skill that goes on with what its jaw holds is told the same."""
        source: SubgoalSource = subgoal_source(self._job.bundle, self._job.task, self._rng)
        if any(held):
            source = KeptSubgoals(self.subgoals, [skill.start for skill in result.skills])
        self.subgoals = source

    def renewed(self, plan: Plan, skill: str, result: EpisodeResult) -> Plan | None:
        """What is left of a plan, planned anew: the thing is not where the plan has it.

        The arms rest, and it is looked at again, first. The gate is disarmed while they plan, as in
        `again`. Where no new plan does the task in the simulator the old one goes on: what is seen
        may be wrong, too.

        Args:
            plan: the old one.
            skill: which begins here.
            result: told what is done.

        Returns:
            What to go on with; None where nothing may go on, as `result` says.
        """
        session = self._session
        if not (halt(session) and rest(session, SETTLE_S)):
            session.come_to_rest(result)
            return None
        try:
            off_m = plan.off(skill, session.seen())
        except DriverError as error:
            session.line.fail(str(error))  # whoever follows the plan finds out
            return plan
        if off_m <= OFF_PLAN_M:
            return plan
        if not self._disarmed(result):
            return None
        try:
            plan, course = self.plan(session.read(), session.scene(), skill), "planned anew"
        except (ViskillError, ValueError) as error:
            course = f"not planned anew ({error}), the old plan goes on"
        words = f"before {skill}: the thing is {1e3 * off_m:.1f} mm off the plan; {course}"
        result.off_plan.append(words)
        now = session.driver.clock.now()
        session.recorder.mark(now, result.episode, skill, 0, words)
        if self._job.operator is not None:
            self._job.operator.tell(words)
        return plan if self._armed_again(result, "gone on with") else None

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
        self._choose_subgoals(held, result)
        plan = None
        if not self._disarmed(result):
            return None
        try:
            plan = self.plan(session.read(), session.scene(), boundary.skill)
        except (ViskillError, ValueError) as error:
            result.reason = f"not tried again: {error}"
        if not self._armed_again(result, "tried again"):
            return None
        if plan is not None:
            result.retries += 1
        elif not go_to_start_pose(session, held):
            session.come_to_rest(result)
        return plan

    def _disarmed(self, result: EpisodeResult) -> bool:
        """Disarms the gate while the arms rest; False where it has stepped in, as is noted."""
        self._session.finish()
        result.stopped_by = self._session.cause
        return not result.stopped_by

    def _armed_again(self, result: EpisodeResult, what: str) -> bool:
        """Arms it again with the operator's consent; False without, as is noted."""
        try:
            self._session.begin()
        except SafetyStop as error:
            result.reason = f"not {what}: {error}"
            return False
        return True
