"""The paper's way to deploy: the policy runs in a simulator, the robot gets the trajectory."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from viskill_deploy.bundle.chain import SkillChain
from viskill_deploy.bundle.format import Bundle
from viskill_deploy.bundle.subgoals import SubgoalSource, subgoal_source
from viskill_deploy.core.arm_errors import without_cables
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import MotionError, SafetyStop
from viskill_deploy.core.types import (
    Action,
    ArmState,
    CellState,
    FloatArray,
    JointSetpoint,
    ObservationRange,
    Scene,
    SkillStart,
    Waypoint,
)
from viskill_deploy.motion.plan import JointPlan, Part, smooth
from viskill_deploy.motion.resolve import densified, resolve
from viskill_deploy.runtime.line import Line
from viskill_deploy.safety.rehearsal import Rehearsal
from viskill_deploy.sim.closed_loop import ClosedLoop
from viskill_deploy.sim.tasks.base import Task, load_task
from viskill_deploy.sim.world import World

OFF_PLAN_M = 1.5e-3
"""What is left of a plan is planned anew where its thing is farther off than this. On the loopback
no thing was between this and 2.3 mm off, in 400 plans."""

LEVER_M = 0.01
"""A thing's turn counts as what it moves a point by that is so far from its origin."""


@dataclass(frozen=True)
class Plan:
    """A whole trajectory.

    Attributes:
        waypoints: where it leads, the first where the arms are.
        motion: the same in joints, smoothed.
        starts: what was decided at each skill's first step.
        training: what the policy has seen in training; None where no policy was asked.
        succeeds: whether it does the task in the simulator.
        scenes: where the things were at each skill's first step, in the simulator.
    """

    waypoints: tuple[Waypoint, ...]
    motion: JointPlan
    starts: Mapping[str, SkillStart]
    training: ObservationRange | None = None
    succeeds: bool = True
    scenes: Mapping[str, Scene] = field(default_factory=dict)

    def first_of(self, skill: str) -> int:
        """Index of a skill's first waypoint."""
        return next(i for i, waypoint in enumerate(self.waypoints) if waypoint.skill == skill)

    def parts(self, skill: str, stops_everywhere: bool = False) -> tuple[Part, ...]:
        """A skill's stretch of the motion, from rest to rest; as one, or from waypoint to waypoint.

        Args:
            skill: its name.
            stops_everywhere: the arms are to rest at every waypoint; the plan was made so.
        """
        count = sum(waypoint.skill == skill for waypoint in self.waypoints)
        first, times = self.first_of(skill), self.motion.waypoint_times
        ends = range(first, first + count) if stops_everywhere else [first + count - 1]
        starts = [first - 1, *ends[:-1]]
        return tuple(
            Part(self.motion, times[a], times[b] - times[a])
            for a, b in zip(starts, ends, strict=True)
        )

    def off(self, skill: str, seen: Scene) -> float:
        """How far the thing to be moved is from where the plan has it when a skill begins.

        Args:
            skill: its name.
            seen: the things that somebody sees, and where.

        Returns:
            m, its shift, and its turn times `LEVER_M`; 0.0 where nobody sees it.
        """
        planned = self.scenes.get(skill, seen)
        poses = {thing.name: thing.T_task_object for thing in seen.objects}
        if planned.active not in poses:
            return 0.0
        T, T_planned = poses[planned.active], planned.pose(planned.active)
        shift = float(np.linalg.norm(T[:3, 3] - T_planned[:3, 3]))
        cosine = (np.trace(T_planned[:3, :3].T @ T[:3, :3]) - 1.0) / 2.0
        return shift + LEVER_M * float(np.arccos(np.clip(cosine, -1.0, 1.0)))

    def index_at(self, time_s: float) -> int:
        """Index of the waypoint that the plan is on its way to at a time of its own."""
        index = bisect_left(self.motion.waypoint_times, time_s - 1e-9)
        return min(index, len(self.waypoints) - 1)

    def check(
        self,
        cell: CellDescription,
        period_s: float,
        state: CellState,
        ik_solver: str = "daqp",
        speed: float = 1.0,
    ) -> dict[str, float]:
        """Puts every setpoint of the plan before a gate that lets nothing out.

        What is judged is what will be streamed: each sample goes through the QP of its tick. The
        arms of this rehearsal follow perfectly, and every jaw is taken for one that holds a thing.

        Returns:
            The smallest margin to every rule, by id: 1.0 far away, 0.0 at the threshold.

        Raises:
            SafetyStop: the gate would step in or ask for less speed; names rule, time and arm.
                Nothing has moved.
        """
        gate, now = Rehearsal(cell, period_s, self.training, speed), 1.0
        line = Line(cell, period_s, ik_solver, speed)
        line.start(state)
        start = _ideal(state, line.setpoints, now, consent=False)
        agreed = replace(start, inputs=replace(start.inputs, consent=True))
        against = gate.begin(start, agreed, now)
        line.follow(self.motion)
        holding = (True,) * len(cell.arms)
        while not against and not line.arrived:
            seen = _ideal(state, line.setpoints, now, consent=True)
            waypoint = self.waypoints[self.index_at(line.phase + period_s)]
            verdicts = gate.judge(seen, line.request(now, waypoint, holding), now)
            against = tuple(v for v in verdicts if v.action >= Action.SCALE)
            line.advance(1.0)
            now += period_s
        if against:
            arm = cell.arms[against[0].arm].name if against[0].arm >= 0 else "the cell"
            raise SafetyStop(
                f"the plan is refused at {line.phase:.2f} s: {against[0].rule} on {arm} "
                f"({against[0].value:.4g}, limit {against[0].limit:.4g}); nothing has moved"
            )
        return gate.margins


def make_plan(
    cell: CellDescription,
    task: Task,
    bundle: Bundle,
    measured: FloatArray,
    held: FloatArray,
    scene: Scene,
    rng: np.random.Generator,
    subgoals: SubgoalSource | None = None,
    first: str = "",
    must_succeed: bool = True,
    rests_everywhere: bool = False,
) -> Plan:
    """Lets the policy do the task in a simulator and smooths what it did.

    All arms rest where one skill ends and the next one begins.

    Args:
        cell: the arms in their places.
        task: what to do.
        bundle: the policy.
        measured: axis positions at which the arms are, (arms, 7): where the simulation starts.
        held: axis positions of the setpoints that their driver holds: where the plan starts.
        scene: where the objects are.
        rng: for the scripted plan's subgoals.
        subgoals: who gives the subgoals; by default, what the bundle asks for.
        first: name of the skill to begin with; the task's first by default.
        must_succeed: whether a plan that does not do the task is refused.
        rests_everywhere: whether the arms rest at every waypoint.

    Raises:
        MotionError: the trajectory cannot be resolved or smoothed inside the limits, or does not
            do the task in the simulator.
    """
    ideal = without_cables(cell)
    loop = ClosedLoop(load_task(task.name, ideal), World(ideal), bundle.manifest.action.spec())
    observation = loop.reset(scene, measured, held)
    chain = SkillChain(bundle, subgoals or subgoal_source(bundle, task, rng), first)
    starts: dict[str, SkillStart] = {}
    scenes: dict[str, Scene] = {}
    skills = {skill.name: skill for skill in task.skills}
    begins = skills[first or task.skills[0].name]
    waypoints = [replace(loop.waypoint, may_open_jaw=begins.may_open_jaw)]
    while not chain.finished:
        choice = chain.act(observation, loop.world.scene())
        starts[choice.skill] = choice.start
        scenes.setdefault(choice.skill, loop.world.scene())
        seen = tuple(observation.tolist())
        observation = loop.step(choice.action, skills[choice.skill])
        waypoints.append(replace(loop.waypoint, observation=seen))
    dense = densified(waypoints)
    q = resolve(cell, dense[1:], held.tolist())
    inner = range(1, len(dense) - 1)
    rests = [i for i in inner if rests_everywhere or dense[i].skill != dense[i + 1].skill]
    motion = smooth(cell, q, cell.file.motion.step_s, rests=rests)
    succeeds = loop.success()
    if must_succeed and not succeeds:
        raise MotionError(
            "the plan does not do the task in the simulator and was not streamed; look at the "
            "scene, or run the policy closed loop"
        )
    seen_in_training = bundle.manifest.training_range.seen
    return Plan(tuple(dense), motion, starts, seen_in_training, succeeds, scenes)


def _ideal(
    state: CellState, setpoints: Sequence[JointSetpoint], now: float, consent: bool
) -> CellState:
    """What arms that follow perfectly would report."""
    arms = tuple(_follows(arm, s, now) for arm, s in zip(state.arms, setpoints, strict=True))
    inputs = replace(
        state.inputs,
        consent=consent,
        consent_stamp_s=now,
        consent_alive_s=now,
        estop=False,
        watchdog_stamp_s=now,
    )
    return CellState(arms, inputs)


def _follows(arm: ArmState, setpoint: JointSetpoint, now: float) -> ArmState:
    return replace(
        arm,
        stamp_s=now,
        measured_jp=setpoint.jp,
        measured_jv=setpoint.jv,
        jaw_measured_jp=setpoint.jaw,
        jaw_measured_jv=setpoint.jaw_v,
        setpoint_jp=setpoint.jp,
        jaw_setpoint_jp=setpoint.jaw,
    )
