"""Cells of the fault matrix: one fault in one phase of a task, on any loopback.

A phase is a saved moment of a real episode, with the waypoints that the policy chose from there on.
The arms start from rest there and are under way when the fault strikes.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from viskill_deploy.bundle.chain import SkillChain
from viskill_deploy.bundle.subgoals import subgoal_source
from viskill_deploy.core.errors import DriverError, SafetyStop
from viskill_deploy.core.types import (
    Action,
    CellState,
    FloatArray,
    JointSetpoint,
    Mode,
    Scene,
    Waypoint,
)
from viskill_deploy.runtime.episodes import run_motion
from viskill_deploy.runtime.fault_injection import FaultInjector
from viskill_deploy.runtime.faults import Fault, Injection, Reaction
from viskill_deploy.runtime.preflight import prepare
from viskill_deploy.runtime.record import Recorder
from viskill_deploy.runtime.session import Session
from viskill_deploy.runtime.thinking import decide
from viskill_deploy.sim.closed_loop import ClosedLoop
from viskill_deploy.sim.world import World

BUNDLE = Path(__file__).parents[2] / "policies" / "bipegtransfer-viskill"

STRIKE_S = 0.4
"""After the first setpoint: the second policy step is under way."""

TOLERATED_S = 0.5
"""For so long a fault that has to be tolerated is kept up."""

PHASES = {
    "approach": ("grasp", 1),
    "grasp": ("grasp", 7),
    "lift": ("grasp", 9),
    "handover": ("handover", 5),
    "release": ("release", 1),
    "rest": ("grasp", 20),
}
"""Skill and step with which each phase starts. In "rest" nothing moves and nobody decides."""

AHEAD = 10
"""Waypoints that a phase goes on for."""


@dataclass(frozen=True)
class Phase:
    """A moment of an episode.

    Attributes:
        scene: of the episode.
        physics: state of the world.
        setpoints: held then, one an arm.
        waypoints: where the policy went from there; none when the arms are to rest.
    """

    name: str
    scene: Scene
    physics: FloatArray
    setpoints: tuple[JointSetpoint, ...]
    waypoints: tuple[Waypoint, ...]

    def declared(self, fault: Fault) -> Reaction:
        """What has to happen here."""
        return fault.reaction if self.waypoints else fault.at_rest


@functools.cache
def prepared() -> Any:
    """The bundle with its task and cell."""
    return prepare(BUNDLE)


@functools.cache
def phases() -> dict[str, Phase]:
    """All phases, from one episode of the policy in its world."""
    job = prepared()
    rng = np.random.default_rng(0)
    scene = job.task.sample_layout(rng, "reference")
    loop = ClosedLoop(job.task, World(job.cell))
    observation = loop.reset(scene)
    chain = SkillChain(job.bundle, subgoal_source(job.bundle, job.task, rng))
    skills = {skill.name: skill for skill in job.task.skills}
    moments, waypoints, starts = [], [], {}
    while not chain.finished:
        choice = chain.act(observation, loop.world.scene())
        starts[choice.skill, choice.step] = len(moments)
        moments.append((loop.world.save(), _held(loop)))
        observation = loop.step(choice.action, skills[choice.skill])
        waypoints.append(loop.waypoint)
    assert loop.success()
    made = {}
    for name, start in PHASES.items():
        at = starts[start]
        way = () if name == "rest" else tuple(waypoints[at : at + AHEAD])
        made[name] = Phase(name, scene, *moments[at], way)
    return made


def _held(loop: ClosedLoop) -> tuple[JointSetpoint, ...]:
    return tuple(JointSetpoint(m.p[:6], (0.0,) * 6, m.p[6], 0.0) for m in loop._motion)


class Notebook:
    """A recorder in memory.

    Attributes:
        robot: time and setpoints that the robot held, one row a cycle.
        actions, modes: of the gate.
    """

    alive = True
    process_id = 0

    def __init__(self, driver: Any) -> None:
        self._driver = driver
        self.robot: list[tuple[float, tuple[float, ...]]] = []
        self.actions: list[Action] = []
        self.modes: list[Mode] = []

    def cycle(self, now: float, state: CellState, request: object, *rest: Any) -> None:
        self.actions.append(rest[1])
        self.modes.append(rest[3])
        try:
            arms = self._driver.state().arms
        except DriverError:  # it has refused something; there is a next time
            return
        held = tuple(x for arm in arms for x in (*arm.setpoint_jp, arm.jaw_setpoint_jp))
        self.robot.append((arms[0].stamp_s, held))

    def scene(self, *args: object) -> None:
        pass

    def mark(self, *args: object) -> None:
        pass


@dataclass
class Cell:
    """What happened in one cell of the matrix.

    Attributes:
        facts: of the fault, what was declared and seen.
        cause: rule for which the gate stepped in; "" if it did not.
        mode: of the gate at the end.
        overruns: cycles for which the machine came late.
        leap: largest way of a setpoint at the robot between two samples, as a part of the way that
            its fastest motion needs.
        creep: largest way of a setpoint at the robot in the 20 ms after the end, rad or m.
        speed: largest speed of a joint then, rad/s or m/s.
    """

    facts: dict[str, Any]
    cause: str
    mode: Mode
    overruns: int
    leap: float
    creep: float
    speed: float


class _Over(BaseException):
    """The time of a cell is up."""


def run_cell(driver: Any, phase: Phase, fault: Fault, recorder: Recorder | None = None) -> Cell:
    """Lets a fault strike in a phase, on a connected loopback, until the arms rest again."""
    cell = prepared().cell
    driver.reset(phase.scene)
    driver.restore(phase.physics, phase.setpoints)
    notebook = Notebook(driver)
    injection = Injection(fault, STRIKE_S, fault.lasts_s)
    faults = FaultInjector([injection], driver, recorder or notebook)
    session = Session(cell, faults.driver, faults.line(cell), _Both(faults.recorder, notebook))
    session.thinking_s = faults.thinking_s
    session.make_ready()
    session.begin()
    declared = phase.declared(fault)
    enough = STRIKE_S + (declared.within_s if declared.rule else TOLERATED_S) + 0.05
    try:
        _go(session, phase.waypoints, lambda: faults.elapsed_s() > enough)
        session.come_to_rest()
        facts, cause = faults.struck[0].facts(), session.cause
    except _Over:
        facts, cause = faults.struck[0].facts(), ""
        session.settle()
    mode, leap = session.gate.mode, _leap(notebook.robot, session)
    before = _state(driver)
    driver.clock.sleep_until(driver.clock.now() + 5 * driver.period_s)
    after = _state(driver)
    arms = list(zip(before.arms, after.arms, strict=True))
    creep = max(
        abs(p - q) for a, b in arms for p, q in zip(a.setpoint_jp, b.setpoint_jp, strict=True)
    )
    speed = max(abs(v) for arm in after.arms for v in arm.measured_jv)
    return Cell(facts, cause, mode, session.overruns, leap, creep, speed)


def _state(driver: Any) -> CellState:
    """The state of a driver that may first have to say what it has refused."""
    while True:
        with contextlib.suppress(DriverError):
            return driver.state()


def _go(session: Session, waypoints: Sequence[Waypoint], is_over: Any) -> None:
    """Returns when the gate has stepped in; raises _Over when it has not in time."""
    cycle = session.cycle

    def timed() -> bool:
        if is_over() and not session.cause:
            raise _Over
        return cycle()

    session.cycle = timed  # type: ignore[method-assign]
    try:
        for waypoint in waypoints:
            try:
                session.go_to(decide(session, lambda waypoint=waypoint: waypoint))
            except (SafetyStop, DriverError):
                return
            if not run_motion(session):
                return
        while session.cycle():
            pass
    finally:
        del session.cycle  # type: ignore[method-assign]


class _Both:
    """Two recorders as one; the first is the one that counts."""

    def __init__(self, first: Recorder, second: Notebook) -> None:
        self._first, self._second = first, second

    @property
    def alive(self) -> bool:
        return self._first.alive

    @property
    def process_id(self) -> int:
        return self._first.process_id

    def cycle(self, *args: Any) -> None:
        self._first.cycle(*args)
        self._second.cycle(*args)

    def scene(self, *args: Any) -> None:
        self._first.scene(*args)

    def mark(self, *args: Any) -> None:
        self._first.mark(*args)


def _leap(robot: list[tuple[float, tuple[float, ...]]], session: Session) -> float:
    fastest = np.array([x for arm in session.gate.envelope.arms for x in arm.max_speed])
    steps = np.maximum(np.diff([time for time, _ in robot]), session.driver.period_s)
    ways = np.abs(np.diff([held for _, held in robot], axis=0)) / (fastest * steps[:, None])
    return float(ways.max(initial=0.0))


def complaints(cell: Cell, declared: Reaction) -> list[str]:
    """What is not as declared."""
    facts, wrong = cell.facts, []
    if not facts["began"]:
        return ["the fault did not begin"]
    if not declared.rule:
        wrong += [f"the gate stepped in: {cell.cause}"] if cell.cause else []
    else:
        seen = f"{facts['seen_action']} by {facts['seen_rules']} after {facts['seen_after_s']} s"
        if facts["seen_action"] != declared.action.name:
            wrong.append(f"{declared.action.name} declared, seen {seen}")
        elif declared.rule not in facts["seen_rules"]:
            wrong.append(f"{declared.rule} declared, seen {seen}")
        elif not facts["seen_after_s"] <= declared.within_s:
            wrong.append(f"declared within {declared.within_s} s, seen {seen}")
    if cell.leap > 2.0:
        wrong.append(f"a setpoint at the robot leapt by {cell.leap:.1f} times its fastest motion")
    if cell.creep > 0.0 or cell.speed > 0.05:
        wrong.append(
            f"the arms do not rest: {cell.creep:.2g} rad or m, {cell.speed:.2g} rad/s or m/s"
        )
    return wrong
