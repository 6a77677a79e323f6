"""One episode: closed loop, where the policy is asked at every step, or a plan that is streamed."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import numpy as np

from viskill_deploy.bundle.chain import SkillChain
from viskill_deploy.bundle.format import Bundle
from viskill_deploy.core.errors import DriverError, ViskillError
from viskill_deploy.core.types import CellState, FloatArray, Scene, Waypoint
from viskill_deploy.motion.resolve import waypoint_at
from viskill_deploy.motion.waypoints import apply_action
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.planning import Plan, make_plan
from viskill_deploy.runtime.session import Session
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
    observation: FloatArray


def closed_loop(
    session: Session, job: Job, rng: np.random.Generator, episode: int
) -> EpisodeResult:
    """Runs the skills in turn, asking the policy at every step."""
    task, result = job.task, EpisodeResult(episode)
    session.make_ready()
    session.begin()
    seen = _look(session, task)
    subgoals = task.subgoals(seen.observation, seen.scene, rng)
    chain = SkillChain(job.bundle, lambda skill, _: subgoals[skill])
    waypoint = waypoint_at(session.cell, axes_of(seen.state))
    while not chain.finished:
        try:
            seen = _look(session, task)
            waypoint = _next_waypoint(session, job, chain, seen, waypoint, result)
        except (ViskillError, ValueError) as error:
            # a policy or a measurement without sense: the gate brings the arms to rest
            session.line.fail(str(error))
        if not run_motion(session):
            session.come_to_rest(result)
            return result
        if chain.between_skills:
            _judge_skill(session, task, result, subgoals[waypoint.skill])
    session.finish()
    result.success = _judge(session, task)
    return result


def _next_waypoint(
    session: Session,
    job: Job,
    chain: SkillChain,
    seen: _Seen,
    last: Waypoint,
    result: EpisodeResult,
) -> Waypoint:
    """Asks the policy and begins the motion to the waypoint that it wants."""
    choice = chain.act(seen.observation)
    note = seen.scene.active if not result.skills else ""
    now = session.driver.clock.now()
    session.recorder.mark(now, result.episode, choice.skill, choice.step, note)
    spec = job.bundle.manifest.action.spec()
    tips, cell = session.tips(seen.state), session.cell
    waypoint = apply_action(
        last, choice.action, tips, cell, spec, choice.skill, choice.may_open_jaw
    )
    stretch = session.go_to(waypoint, last=chain.finished)
    skill = result.skill(choice.skill)
    skill.steps, skill.stretch_max = choice.step + 1, max(skill.stretch_max, stretch)
    return waypoint


def planned(
    session: Session, job: Job, rng: np.random.Generator, episode: int, speed: float = 1.0
) -> EpisodeResult:
    """Makes the whole plan in a simulator, checks it, and only then streams it."""
    state, scene = session.make_ready(), _seen(session)
    plan = make_plan(session.cell, job.task, job.bundle, axes_of(state), scene, rng, speed)
    plan.check(session.cell, session.driver.period_s, state)
    session.begin()
    result = EpisodeResult(episode)
    session.line.follow(plan.motion)
    index = 0
    while not session.line.arrived:
        reached = plan.index_at(session.line.phase + session.driver.period_s)
        if reached != index:
            _pass_waypoint(session, job.task, plan, result, index, reached)
            index = reached
        session.allow(plan.waypoints[index])
        if not session.cycle():
            session.come_to_rest(result)
            return result
    session.finish()
    _judge_skill(session, job.task, result, plan.subgoals[plan.waypoints[-1].skill])
    for skill in result.skills:
        skill.stretch_max = plan.motion.stretch
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
        _judge_skill(session, task, result, plan.subgoals[before])
    step, note = ahead - plan.first_of(name), _seen(session).active if not before else ""
    result.skill(name).steps = step + 1
    session.recorder.mark(session.driver.clock.now(), result.episode, name, step, note)


def _judge_skill(session: Session, task: Task, result: EpisodeResult, subgoal: FloatArray) -> None:
    """Whether the skill that is running has reached its subgoal, where the simulator can tell."""
    if session.driver.capabilities.simulated:
        skill = result.skills[-1]
        with contextlib.suppress(ViskillError, ValueError):  # nothing to judge by
            observation = _look(session, task).observation
            reached = task.achieved(skill.name, observation, session.driver.active_object().touched)
            skill.success = task.skill_success(reached, subgoal)


def _seen(session: Session) -> Scene:
    scene = session.driver.scene()
    if scene is None:
        raise DriverError("nothing says where the objects are; give a scene")
    return scene


def _look(session: Session, task: Task) -> _Seen:
    state, scene = session.driver.state(), _seen(session)
    jaws = [arm.jaw_measured_jp for arm in state.arms]
    return _Seen(state, scene, task.observe(session.tips(state), jaws, scene))


def _judge(session: Session, task: Task) -> bool:
    """Task success by the simulator's truth; False where nobody can tell."""
    if not session.driver.capabilities.simulated:
        return False
    return task.success(session.driver.active_object(), _seen(session))
