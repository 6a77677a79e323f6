"""Episodes for learning: who drives, what the scripted controller would have done, how it ended."""

from __future__ import annotations

import functools
import multiprocessing
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import onnxruntime

from viskill_deploy.core.errors import KinematicsError, MotionError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.motion.waypoints import ACTION_SIZE
from viskill_deploy.sim.closed_loop import ClosedLoop
from viskill_deploy.sim.tasks.base import SkillSpec, Task, load_task

Float32Array = npt.NDArray[np.float32]
Policy = Callable[[FloatArray, FloatArray], FloatArray]
"""(observation, subgoal) → action."""


@dataclass(frozen=True, slots=True)
class Request:
    """One episode to run.

    Attributes:
        task: the task's name.
        entropy: seeds the layout, the subgoals and the disturbance.
        distribution: of the layout.
        learner_drives: per skill; the scripted controller drives the others.
        disturbance: standard deviation of what is added to displacements and turns of the driver's
            actions, so that the script is also asked about states that it does not visit.
    """

    task: str
    entropy: tuple[int, ...]
    distribution: str
    learner_drives: tuple[bool, ...]
    disturbance: float = 0.0


@dataclass(frozen=True, slots=True)
class SkillRecord:
    """One skill's run: observations (n, o), subgoals (n, g) and the script's actions (n, a)."""

    skill: str
    obs: Float32Array
    goal: Float32Array
    action: Float32Array
    reached: bool


@dataclass(frozen=True, slots=True)
class EpisodeRecord:
    """A whole episode: its skills, and whether the task was done at the last step."""

    request: Request
    skills: tuple[SkillRecord, ...]
    success: bool


def onnx_policy(graph: bytes) -> Policy:
    """A policy that runs a skill's graph on one thread."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])

    def act(obs: FloatArray, goal: FloatArray) -> FloatArray:
        feed = {"obs": obs[None].astype(np.float32), "goal": goal[None].astype(np.float32)}
        return np.asarray(session.run(["action"], feed)[0][0], dtype=np.float64)

    return act


def run_episode(
    loop: ClosedLoop, request: Request, policies: Mapping[str, Policy]
) -> EpisodeRecord:
    """Runs one episode; every state is labelled with the scripted controller's action.

    An action that no motion inside the limits can follow ends the episode without success.
    """
    task = loop.task
    rng = np.random.default_rng(request.entropy)
    obs = loop.reset(task.sample_layout(rng, request.distribution))
    goals = task.subgoals(obs, loop.world.scene(), rng)
    records: list[SkillRecord] = []
    for skill, learner in zip(task.skills, request.learner_drives, strict=True):
        policy = policies[skill.name] if learner else _script(task, skill)
        try:
            obs, record = _run_skill(
                loop, skill, policy, obs, goals[skill.name], request.disturbance, rng
            )
        except (KinematicsError, MotionError):
            return EpisodeRecord(request, tuple(records), False)
        records.append(record)
    return EpisodeRecord(request, tuple(records), loop.success())


def _script(task: Task, skill: SkillSpec) -> Policy:
    return functools.partial(task.scripted_action, skill.name)


def _run_skill(
    loop: ClosedLoop,
    skill: SkillSpec,
    policy: Policy,
    obs: FloatArray,
    goal: FloatArray,
    disturbance: float,
    rng: np.random.Generator,
) -> tuple[FloatArray, SkillRecord]:
    task = loop.task
    seen, labels = [], []
    for _ in range(skill.budget):
        seen.append(obs)
        labels.append(task.scripted_action(skill.name, obs, goal))
        action = policy(obs, goal)
        if disturbance:
            action = action + _nudge(len(action), disturbance, rng)
        obs = loop.step(action, skill)
    achieved = task.achieved(skill.name, obs, loop.flags())
    reached = bool(task.skill_success(skill.name, achieved, goal))
    rows = np.asarray(seen, dtype=np.float32)
    goals = np.tile(goal.astype(np.float32), (len(rows), 1))
    return obs, SkillRecord(skill.name, rows, goals, np.asarray(labels, np.float32), reached)


def _nudge(size: int, disturbance: float, rng: np.random.Generator) -> FloatArray:
    nudge = rng.normal(0.0, disturbance, size)
    nudge[ACTION_SIZE - 1 :: ACTION_SIZE] = 0.0  # jaws are never opened by chance
    return nudge


@functools.cache
def _loop(task: str) -> ClosedLoop:
    """One world a process, built at its first episode."""
    return ClosedLoop(load_task(task))


def _run_here(request: Request, graphs: Mapping[str, bytes]) -> EpisodeRecord:
    policies = {name: onnx_policy(graph) for name, graph in graphs.items()}
    return run_episode(_loop(request.task), request, policies)


@contextmanager
def workers(count: int) -> Iterator[ProcessPoolExecutor | None]:
    """Processes to share episodes among; none for a count of one."""
    if count <= 1:
        yield None
        return
    context = multiprocessing.get_context("spawn")  # a fork would copy torch's threads half-way
    with ProcessPoolExecutor(count, mp_context=context) as pool:
        yield pool


def run_episodes(
    requests: Iterable[Request], graphs: Mapping[str, bytes], pool: ProcessPoolExecutor | None
) -> list[EpisodeRecord]:
    """Runs episodes, in `pool` if there is one; the result does not depend on it.

    Args:
        requests: the episodes.
        graphs: the learner's ONNX graph for every skill that it drives.
        pool: worker processes.
    """
    run = functools.partial(_run_here, graphs=dict(graphs))
    return list(pool.map(run, requests, chunksize=2) if pool else map(run, requests))
