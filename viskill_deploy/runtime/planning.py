"""The paper's way to deploy: the policy runs in a simulator, the robot gets the trajectory."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from viskill_deploy.bundle.chain import SkillChain
from viskill_deploy.bundle.format import Bundle
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import SafetyStop
from viskill_deploy.core.types import (
    Action,
    ArmState,
    CellState,
    FloatArray,
    Request,
    Scene,
    Waypoint,
)
from viskill_deploy.motion.plan import JointPlan, smooth
from viskill_deploy.motion.resolve import densified, resolve
from viskill_deploy.motion.smoothing import AxisMotion
from viskill_deploy.safety.supervisor import Supervisor
from viskill_deploy.sim.closed_loop import ClosedLoop
from viskill_deploy.sim.tasks.base import Task
from viskill_deploy.sim.world import World


@dataclass(frozen=True)
class Plan:
    """A whole trajectory.

    Attributes:
        waypoints: where it leads, the first where the arms are.
        motion: the same in joints, smoothed.
        subgoals: what each skill was told to reach.
        success: whether the task was done in the simulator that made it.
    """

    waypoints: tuple[Waypoint, ...]
    motion: JointPlan
    subgoals: Mapping[str, FloatArray]
    success: bool

    def first_of(self, skill: str) -> int:
        """Index of a skill's first waypoint."""
        return next(i for i, waypoint in enumerate(self.waypoints) if waypoint.skill == skill)

    def index_at(self, time_s: float) -> int:
        """Index of the waypoint that the plan is on its way to at a time of its own."""
        index = bisect_left(self.motion.waypoint_times, time_s - 1e-9)
        return min(index, len(self.waypoints) - 1)

    def _request(self, motion: Sequence[AxisMotion], time_s: float) -> Request:
        """The request at a time, every jaw taken for one that holds something."""
        setpoints = tuple(m.setpoint() for m in motion)
        may_open = self.waypoints[self.index_at(time_s)].may_open_jaw
        return Request(setpoints, may_open_jaw=may_open, holding=(True,) * len(setpoints))

    def check(self, cell: CellDescription, period_s: float, state: CellState) -> None:
        """Puts every setpoint of the plan before a gate of its own, with ideal arms.

        Raises:
            SafetyStop: the gate would step in; names rule, time and arm. Nothing has moved.
        """
        gate = Supervisor(cell, period_s)
        at_rest = [
            AxisMotion.at_rest((*arm.setpoint_jp, arm.jaw_setpoint_jp)) for arm in state.arms
        ]
        now = 1.0
        gate.connect(_ideal(state, at_rest, now, consent=False))
        against = gate.arm(_ideal(state, at_rest, now, consent=True), now)
        if against:
            raise SafetyStop(f"the plan cannot start: {_named(against[0].rule, cell, 0)}")
        motion: Sequence[AxisMotion] = at_rest
        for i in range(round(self.motion.duration_s / period_s + 0.5)):
            seen = _ideal(state, motion, now, consent=True)
            motion = self.motion.at((i + 1) * period_s)
            decision = gate.check(seen, self._request(motion, (i + 1) * period_s), now)
            bad = [v for v in decision.verdicts if v.action >= Action.HOLD]
            if bad:
                raise SafetyStop(
                    f"the plan is refused at {i * period_s:.2f} s: "
                    f"{_named(bad[0].rule, cell, bad[0].arm)}; nothing has moved"
                )
            now += period_s


def make_plan(
    cell: CellDescription,
    task: Task,
    bundle: Bundle,
    axes: FloatArray,
    scene: Scene,
    rng: np.random.Generator,
    speed: float = 1.0,
) -> Plan:
    """Lets the policy do the task in a simulator and smooths what it did.

    Args:
        cell: the arms in their places.
        task: what to do.
        bundle: the policy.
        axes: axis positions of the arms, (arms, 7).
        scene: where the objects are.
        rng: for the scripted subgoals.
        speed: part of the planned tip speed to use.

    Raises:
        MotionError: the trajectory cannot be resolved or smoothed inside the limits.
    """
    loop = ClosedLoop(task, World(cell))
    observation = loop.reset(scene, axes)
    subgoals = task.subgoals(observation, scene, rng)
    chain = SkillChain(bundle, lambda skill, _: subgoals[skill])
    skills = {skill.name: skill for skill in task.skills}
    first = task.skills[0]
    waypoints = [replace(loop.waypoint, may_open_jaw=first.may_open_jaw)]
    while not chain.finished:
        choice = chain.act(observation)
        observation = loop.step(choice.action, skills[choice.skill])
        waypoints.append(loop.waypoint)
    dense = densified(waypoints)
    q = resolve(cell, dense[1:], axes.tolist())
    motion = smooth(cell, q, cell.file.motion.step_s, speed)
    return Plan(tuple(dense), motion, subgoals, loop.success())


def _ideal(state: CellState, motion: Sequence[AxisMotion], now: float, consent: bool) -> CellState:
    """What arms that follow perfectly would report."""
    arms = tuple(_follows(arm, m, now) for arm, m in zip(state.arms, motion, strict=True))
    inputs = replace(state.inputs, consent=consent, consent_stamp_s=now, estop=False)
    return CellState(arms, inputs)


def _follows(arm: ArmState, motion: AxisMotion, now: float) -> ArmState:
    return replace(
        arm,
        stamp_s=now,
        measured_jp=motion.p[:6],
        measured_jv=motion.v[:6],
        jaw_measured_jp=motion.p[6],
        jaw_measured_jv=motion.v[6],
        setpoint_jp=motion.p[:6],
        jaw_setpoint_jp=motion.p[6],
    )


def _named(rule: str, cell: CellDescription, arm: int) -> str:
    where = cell.arms[arm].name if arm >= 0 else "the cell"
    return f"{rule} on {where}"
