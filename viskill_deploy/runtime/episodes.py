"""One episode: closed loop, where the policy is asked at every step, or a plan that is streamed."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from viskill_deploy.bundle.chain import Choice, SkillChain
from viskill_deploy.bundle.format import Bundle
from viskill_deploy.bundle.subgoals import subgoal_source
from viskill_deploy.core.errors import DriverError, ViskillError
from viskill_deploy.core.types import CellState, FloatArray, Scene, SkillStart, Waypoint
from viskill_deploy.motion.resolve import waypoint_at
from viskill_deploy.motion.waypoints import apply_action
from viskill_deploy.runtime.ledger import EpisodeResult, SkillResult
from viskill_deploy.runtime.planning import Plan, make_plan
from viskill_deploy.runtime.session import Session
from viskill_deploy.runtime.thinking import decide
from viskill_deploy.sim.tasks.base import Task


@dataclass(frozen=True, slots=True)
class Job:
    """What an episode runs: a bundle on its task."""

    bundle: Bundle
    task: Task


@dataclass(frozen=True, slots=True)
class _Seen:
    """State, scene and observation of one moment."""

    state: CellState
    scene: Scene
    tips: list[FloatArray]
    observation: FloatArray


def closed_loop(
    session: Session, job: Job, rng: np.random.Generator, episode: int
) -> EpisodeResult:
    """Runs the skills in turn, asking the policy at every step."""
    task, result = job.task, EpisodeResult(episode)
    session.make_ready()
    session.begin()
    seen = _look(session, task)
    chain = SkillChain(job.bundle, subgoal_source(job.bundle, task, rng))
    waypoint = waypoint_at(session.cell, axes_of(seen.state))
    session.recorder.mark(session.driver.clock.now(), episode, "", 0, seen.scene.active)
    while not chain.finished:
        try:
            think = partial(_next_step, job, chain, _look(session, task), waypoint)
            step = decide(session, think)
            waypoint = step.waypoint
            _begin_step(session, step, result)
        except (ViskillError, ValueError) as error:
            # a policy or a measurement without sense: the gate brings the arms to rest
            session.line.fail(str(error))
        if not run_motion(session):
            session.come_to_rest(result)
            return result
        if chain.between_skills:
            _judge_skill(session, task, result)
    session.finish()
    result.stopped_by = session.cause
    result.success = _judge(session, task)
    return result


@dataclass(frozen=True, slots=True)
class _Step:
    """What the policy wants next."""

    choice: Choice
    waypoint: Waypoint
    is_last: bool


def _next_step(job: Job, chain: SkillChain, seen: _Seen, last: Waypoint) -> _Step:
    """Asks the policy and works out the waypoint that it wants; touches nothing of the session."""
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
    return _Step(choice, waypoint, chain.finished)


def _begin_step(session: Session, step: _Step, result: EpisodeResult) -> None:
    choice = step.choice
    skill = _note_step(session, result, choice.start, choice.step)
    skill.stretch_max = max(skill.stretch_max, session.go_to(step.waypoint, last=step.is_last))


def _note_step(
    session: Session, result: EpisodeResult, start: SkillStart, step: int
) -> SkillResult:
    """Records a policy step; with a skill's first, what was decided there."""
    skill, begins = result.skill(start)
    now = session.driver.clock.now()
    session.recorder.mark(now, result.episode, start.skill, step, start=start if begins else None)
    skill.steps = step + 1
    return skill


def planned(
    session: Session, job: Job, rng: np.random.Generator, episode: int, speed: float = 1.0
) -> EpisodeResult:
    """Makes the whole plan in a simulator, checks it, and only then streams it."""
    state, scene, cell = session.make_ready(), _seen(session), session.cell
    held = axes_of(state)
    measured = held.copy()  # of a jaw that squeezes, only the setpoint says how much
    measured[:, :6] = [arm.measured_jp for arm in state.arms]
    plan = make_plan(cell, job.task, job.bundle, measured, held, scene, rng, speed)
    plan.check(cell, session.driver.period_s, state, session.line.ik_solver)
    session.begin()
    result = EpisodeResult(episode)
    session.recorder.mark(session.driver.clock.now(), episode, "", 0, scene.active)
    session.line.follow(plan.motion)
    index = 0
    while not session.line.arrived:
        ahead = plan.index_at(session.line.phase + session.driver.period_s)
        if ahead != index:
            _pass_waypoint(session, job.task, plan, result, index, ahead)
            index = ahead
        session.allow(plan.waypoints[index])
        if not session.cycle():
            session.come_to_rest(result)
            return result
    session.finish()
    result.stopped_by = session.cause
    _judge_skill(session, job.task, result)
    result.success = _judge(session, job.task)
    return result


def run_motion(session: Session) -> bool:
    """Cycles until the motion is over; False when the gate has stepped in."""
    while True:
        if not session.cycle():
            return False
        if session.line.arrived:
            return True


def axes_of(state: CellState) -> FloatArray:
    """Axis positions of the setpoints that the driver holds, (arms, 7), jaw last."""
    return np.array([(*arm.setpoint_jp, arm.jaw_setpoint_jp) for arm in state.arms])


def _pass_waypoint(
    session: Session, task: Task, plan: Plan, result: EpisodeResult, passed: int, ahead: int
) -> None:
    """Notes that the plan is on its way to the waypoint `ahead`; judges a skill that has ended."""
    name, before = plan.waypoints[ahead].skill, plan.waypoints[passed].skill
    if before and name != before:
        _judge_skill(session, task, result)
    skill = _note_step(session, result, plan.starts[name], ahead - plan.first_of(name))
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


def _seen(session: Session) -> Scene:
    scene = session.driver.scene()
    if scene is None:
        raise DriverError("nothing says where the objects are; give a scene")
    return scene


def _look(session: Session, task: Task) -> _Seen:
    state, scene = session.read(), _seen(session)
    jaws, tips = [arm.jaw_measured_jp for arm in state.arms], session.tips(state)
    return _Seen(state, scene, tips, task.observe(tips, jaws, scene))


def _judge(session: Session, task: Task) -> bool:
    """Task success by the simulator's truth; False where nobody can tell."""
    if not session.driver.capabilities.simulated:
        return False
    return task.success(session.driver.active_object(), _seen(session))
