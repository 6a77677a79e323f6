"""One episode: closed loop, where the policy is asked at every step, or a plan that is streamed."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from viskill_deploy.bundle.chain import Choice, SkillChain, value_at
from viskill_deploy.core.errors import ViskillError
from viskill_deploy.core.types import (
    Boundary,
    CellState,
    FloatArray,
    Scene,
    SkillStart,
    Waypoint,
)
from viskill_deploy.motion.plan import Part
from viskill_deploy.motion.resolve import waypoint_at
from viskill_deploy.motion.waypoints import apply_action
from viskill_deploy.runtime.approach import approach
from viskill_deploy.runtime.attempts import Attempts
from viskill_deploy.runtime.boundaries import Boundaries, Job, Stops, held_now
from viskill_deploy.runtime.jaws import measure_empty_jaws
from viskill_deploy.runtime.ledger import EpisodeResult, SkillResult
from viskill_deploy.runtime.line import Coming
from viskill_deploy.runtime.moves import arrive, axes_of, go_to_start_pose, run_motion
from viskill_deploy.runtime.operator import Operator
from viskill_deploy.runtime.planning import OFF_PLAN_M, Plan
from viskill_deploy.runtime.session import Session
from viskill_deploy.runtime.stopping_places import may_go_on
from viskill_deploy.runtime.thinking import decide
from viskill_deploy.sim.tasks.base import Task

LEAD_S = 0.02
"""Against the clock the policy is asked so long before a step ends. It and the planner then think
while the arms go on, and no control period has to wait for them. What they see is as old as this
when the next step begins."""


@dataclass(frozen=True, slots=True)
class _Seen:
    """State, scene and observation of one moment."""

    state: CellState
    scene: Scene
    tips: list[FloatArray]
    observation: FloatArray


Mode = Literal["closed-loop", "plan"]


def from_start_pose(
    session: Session,
    mode: Mode,
    job: Job,
    rng: np.random.Generator,
    episode: int,
    operator: Operator | None = None,
) -> EpisodeResult:
    """Makes the arms ready and takes them to their start pose, where policies learned to begin.

    Arms that stand where their file has the start pose are beside it once they are calibrated.
    """
    result = EpisodeResult(episode)
    session.make_ready()
    if not approach(session, result, operator):
        return result
    return (planned if mode == "plan" else closed_loop)(session, job, rng, episode)


def closed_loop(
    session: Session, job: Job, rng: np.random.Generator, episode: int
) -> EpisodeResult:
    """Runs the skills in turn, asking the policy at every step; the arms are ready."""
    task, result = job.task, EpisodeResult(episode)
    if not measure_empty_jaws(session, result):
        return result
    session.begin()
    seen = _look(session, task)
    attempts = Attempts(session, job, rng)
    chain: SkillChain | None = SkillChain(job.bundle, attempts.subgoals)
    session.recorder.mark(session.driver.clock.now(), episode, "", 0, seen.scene.active)
    while chain is not None:
        plan = attempts.next(_run_chain(session, job, chain, result), result)
        first = next(iter(plan.starts)) if plan else ""
        chain = SkillChain(job.bundle, attempts.subgoals, first) if plan else None
    return _ended(session, job, result)


def _run_chain(
    session: Session, job: Job, chain: SkillChain, result: EpisodeResult
) -> Boundary | None:
    """Runs a chain from where the arms are.

    Returns:
        The boundary at which the runtime does not go on. None at the chain's end, and when the
        gate has stepped in; the arms are at rest then, and `result` says for what.
    """
    waypoint = waypoint_at(session.cell, axes_of(session.read()))
    boundaries, is_stepped = Boundaries(session, job, result), session.driver.capabilities.stepped
    while not chain.finished:
        try:
            seen, coming = _look(session, job.task), session.line.coming()
            step = decide(session, partial(_next_step, job, chain, seen, waypoint, coming))
            if step.choice.step == 0:
                boundary = boundaries.before(step.choice.start)
                if boundary is None or boundary.course != "go on":
                    return boundary
            if not _is_next(session, job, step, result):
                return None
            if not arrive(session):
                session.come_to_rest(result)
                return None
            waypoint = step.waypoint
            _begin_step(session, step, result, coming)
        except (ViskillError, ValueError) as error:
            # a policy or a measurement without sense: the gate brings the arms to rest
            session.line.fail(str(error))
        is_stop = chain.between_skills or job.stops == "waypoint"
        if not run_motion(session, 0.0 if is_stop or is_stepped else LEAD_S):
            session.come_to_rest(result)
            return None
        if chain.between_skills:
            _judge_skill(session, job.task, result)
        else:
            lost = boundaries.within(waypoint.skill, may_halt=True)
            if lost is not None or result.stopped_by:
                return lost
    return None


def _ended(session: Session, job: Job, result: EpisodeResult) -> EpisodeResult:
    """The episode's result, judged; the gate is disarmed where it has not stepped in."""
    may_retreat = job.retreats and session.is_armed and not result.stopped_by
    if may_retreat and not go_to_start_pose(session, held_now(session)):
        session.come_to_rest(result)
    if not result.stopped_by:
        session.finish()
        result.stopped_by = session.cause
        result.success = job.has_things and _judge(session, job.task)
    return result


@dataclass(frozen=True, slots=True)
class _Step:
    """What the policy wants next."""

    choice: Choice
    waypoint: Waypoint
    rests: bool


def _next_step(
    job: Job, chain: SkillChain, seen: _Seen, last: Waypoint, coming: Coming | None
) -> _Step:
    """Asks the policy, and works out the waypoint that it wants and the segment that leads there.

    Touches nothing of the session but `coming`, which is for it.
    """
    choice = chain.act(seen.observation, seen.scene)
    wanted = apply_action(
        last,
        choice.action,
        seen.tips,
        job.task.cell,
        job.bundle.manifest.action.spec(),
        choice.skill,
        choice.may_open_jaw,
    )
    waypoint = replace(wanted, observation=tuple(seen.observation.tolist()))
    ends_skill = chain.between_skills
    rests = chain.finished or job.stops == "waypoint" or (ends_skill and job.stops == "skill")
    if coming:
        coming.plan(waypoint, rests)
    return _Step(choice, waypoint, rests)


def _is_next(session: Session, job: Job, step: _Step, result: EpisodeResult) -> bool:
    """Whether the step may begin, as the operator says where they are asked."""
    choice = step.choice
    place: Stops = "waypoint" if choice.step else "skill"
    return may_go_on(session, job, place, f"{choice.skill}, step {choice.step + 1}", result)


def _begin_step(
    session: Session, step: _Step, result: EpisodeResult, coming: Coming | None
) -> None:
    choice = step.choice
    skill = _note_step(session, result, choice.start, choice.step)
    skill.stretch_max = max(skill.stretch_max, session.go_to(step.waypoint, step.rests, coming))


def _note_step(
    session: Session, result: EpisodeResult, start: SkillStart, step: int
) -> SkillResult:
    """Records a policy step; with a skill's first, what was decided there."""
    skill, begins = result.skill(start)
    now = session.driver.clock.now()
    session.recorder.mark(now, result.episode, start.skill, step, start=start if begins else None)
    skill.steps = step + 1
    return skill


def planned(session: Session, job: Job, rng: np.random.Generator, episode: int) -> EpisodeResult:
    """Makes the whole plan in a simulator, checks it, and only then streams it, skill by skill.

    The arms are ready.
    """
    result = EpisodeResult(episode)
    if job.has_things and not measure_empty_jaws(session, result):
        return result
    attempts, scene = Attempts(session, job, rng), session.scene()
    plan: Plan | None = attempts.plan(session.driver.state(), scene)
    session.begin()
    session.recorder.mark(session.driver.clock.now(), episode, "", 0, scene.active)
    while plan is not None:
        plan = attempts.next(_stream(session, job, attempts, plan, result), result)
    return _ended(session, job, result)


def _stream(
    session: Session, job: Job, attempts: Attempts, plan: Plan, result: EpisodeResult
) -> Boundary | None:
    """Streams a plan from where the arms are; returns what `_run_chain` does."""
    boundaries, left = Boundaries(session, job, result), plan
    for number, skill in enumerate(plan.starts):
        start, is_off = left.starts[skill], False
        try:
            start = _as_seen(session, job, start)
            boundary = boundaries.before(start)
            if boundary is None or boundary.course != "go on":
                return boundary
            if number and job.has_things:
                is_off = left.off(skill, session.seen()) > OFF_PLAN_M
        except (ViskillError, ValueError) as error:
            session.line.fail(str(error))
        if is_off:
            renewed = attempts.renewed(left, skill, result)
            if renewed is None:
                return None
            left, start = renewed, renewed.starts[skill]
        lost = _stream_skill(session, job, left, start, result, boundaries)
        if lost is not None or result.stopped_by:
            return lost
        if job.has_things:
            _judge_skill(session, job.task, result)
    return None


def _as_seen(session: Session, job: Job, start: SkillStart) -> SkillStart:
    """A skill's start of a plan, with the value as it is seen now instead of in the simulator."""
    if not job.has_things:
        return start
    seen = _look(session, job.task)
    return replace(start, value=value_at(job.bundle, start, seen.observation, seen.scene))


def _stream_skill(
    session: Session,
    job: Job,
    plan: Plan,
    start: SkillStart,
    result: EpisodeResult,
    boundaries: Boundaries,
) -> Boundary | None:
    """Streams one skill of a plan; returns what `_run_chain` does."""
    for number, part in enumerate(plan.parts(start.skill, job.stops == "waypoint")):
        place: Stops = "waypoint" if number else "skill"
        what = f"{start.skill}, waypoint {number + 1}" if number else start.skill
        if not session.line.fault:
            if not may_go_on(session, job, place, what, result):
                return None
            session.line.follow(part)
        lost = _stream_part(session, plan, part, start, result, boundaries)
        if lost is not None or result.stopped_by:
            return lost
    return None


def _stream_part(
    session: Session,
    plan: Plan,
    part: Part,
    start: SkillStart,
    result: EpisodeResult,
    boundaries: Boundaries,
) -> Boundary | None:
    """Streams a part of a skill, from rest to rest; returns what `_run_chain` does."""
    began = part.start_s
    index = plan.index_at(began)
    while True:
        ahead = plan.index_at(began + session.line.phase + session.driver.period_s)
        if ahead != index and plan.waypoints[ahead].skill == start.skill:
            lost = boundaries.within(start.skill, may_halt=False)
            if lost is not None:
                return lost
            _pass_waypoint(session, plan, start, result, ahead)
            index = ahead
        session.allow(plan.waypoints[index])
        if not session.cycle():
            session.come_to_rest(result)
            return None
        if session.line.arrived:
            return None


def _pass_waypoint(
    session: Session, plan: Plan, start: SkillStart, result: EpisodeResult, ahead: int
) -> None:
    """Notes that the plan is on its way to the waypoint `ahead` of a skill."""
    skill = _note_step(session, result, start, ahead - plan.first_of(start.skill))
    times = plan.motion.waypoint_times
    stretch = (times[ahead] - times[ahead - 1]) / plan.waypoints[ahead].step_s
    skill.stretch_max = max(skill.stretch_max, stretch)


def _judge_skill(session: Session, task: Task, result: EpisodeResult) -> None:
    """Whether the skill that is running has reached its subgoal, where the simulator can tell."""
    if session.driver.capabilities.simulated:
        skill = result.skills[-1]
        name, subgoal = skill.start.skill, skill.start.subgoal
        with contextlib.suppress(ViskillError, ValueError):  # nothing to judge by
            observation = _look(session, task).observation
            flags = task.flags(session.driver.active_object())
            reached = task.achieved(name, observation, flags)
            skill.success = bool(task.skill_success(name, reached, subgoal))


def _look(session: Session, task: Task) -> _Seen:
    state, scene = session.read(), session.scene()
    jaws, tips = [arm.jaw_measured_jp for arm in state.arms], session.tips(state)
    return _Seen(state, scene, tips, task.observe(tips, jaws, scene))


def _judge(session: Session, task: Task) -> bool:
    """Task success by the simulator's truth; False where nobody can tell."""
    if not session.driver.capabilities.simulated:
        return False
    return task.success(session.driver.active_object(), session.scene())
