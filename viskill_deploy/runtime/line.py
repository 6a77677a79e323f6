"""The line from a waypoint to a request for the gate: IK, smoothing, and one QP a tick an arm.

A waypoint becomes joint targets (closed form or QP), a jerk-limited segment leads there, and in
every control period the QP resolves the segment's pose again inside the joint limits and with the
remote centre at the registered port. While no limit is active the QP returns the segment itself.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import pinocchio as pin

from viskill_deploy.core.description import CellArm, CellDescription
from viskill_deploy.core.errors import KinematicsError, MotionError, ViskillError
from viskill_deploy.core.types import (
    CellState,
    Joints,
    JointSetpoint,
    Request,
    Waypoint,
)
from viskill_deploy.kinematics.arm import Arm
from viskill_deploy.kinematics.ik import IkSolver
from viskill_deploy.kinematics.model import SHAFT_FRAME
from viskill_deploy.kinematics.port import PortConstraint
from viskill_deploy.kinematics.straight import DAMPING, StraightArm
from viskill_deploy.motion.links import CellLinks
from viskill_deploy.motion.smoothing import (
    AxisMotion,
    Segment,
    SegmentPlanner,
    passing_velocity,
)

OFF_REFERENCE = 1e-3
"""Rad or m. A segment starts from the commanded joints instead of the last segment's end when the
QP was held back from it by more than this."""

RATE_CHANGE_PER_S = 1.0
"""How fast the time base may change its rate: a jump in rate would be a jump in joint speed. At
full speed this adds 1.4 rad/s² to a joint, a fifth of what the gate allows."""

RATE_BEND_PER_S2 = 5.0
"""How fast that change may begin and end: a jump in it would be a jump in acceleration. At full
speed this adds 7 rad/s³ to a joint, a twentieth of what the gate allows."""

PHASE_TOLERANCE = 1e-6
"""Seconds by which a sum of control periods may miss the end of a motion: rounding."""

ROUNDING = 1e-9
"""Rad, m, and per s and s², by which two states may differ and be the same."""

LEAST = 1e-9
"""Damping of a PSM's QP, whose task leaves nothing open."""

AT_REST = 1e-6
"""Rad/s or m/s below which an axis counts as standing still."""

SLOWEST = 0.1
"""Slowest rate of the time base that SCALE requests lead to, as a part of its full rate."""


class Motion(Protocol):
    """Anything that knows where all arms shall be at a time since its start."""

    @property
    def duration_s(self) -> float:
        """Its length."""
        ...

    def at(self, t: float) -> tuple[AxisMotion, ...]:
        """State of every arm `t` seconds after its start."""
        ...


@dataclass
class Coming:
    """The segment after the present one, for another thread to plan while the line goes on.

    Attributes:
        start: where the present segment ends.
        links: the line's own but for its `turns`, which are those at `start`.
        planner: the line's own.
        segment: from there on, once it is planned.
    """

    start: tuple[AxisMotion, ...]
    links: CellLinks
    planner: SegmentPlanner
    segment: Segment | None = None

    def plan(self, waypoint: Waypoint, last: bool) -> Segment:
        """The segment to a waypoint, at rest there if it is the last.

        Raises:
            KinematicsError, MotionError: there is none.
        """
        target = self.links.targets(waypoint, self.start)
        rest = [[0.0] * len(row) for row in target]
        passing = passing_velocity(self.start, np.array(target), waypoint.step_s)
        end = rest if last else passing
        self.segment = self.planner.plan(self.start, target, end, waypoint.step_s)
        return self.segment


class Line:
    """Resolves, smooths and samples the motion of all arms under one time base.

    Args:
        cell: the arms in their places.
        period_s: control period.
        ik_solver: "daqp" or any solver that qpsolvers knows.
        speed: how fast the time base runs, in (0, 1]: the same way, at a part of every speed.

    Attributes:
        rate: speed of the time base, `speed` unless the gate has asked for less.
        links: between the task frame and the joints.
    """

    def __init__(
        self, cell: CellDescription, period_s: float, ik_solver: str = "daqp", speed: float = 1.0
    ) -> None:
        if not 0.0 < speed <= 1.0:
            raise MotionError("speed must be in (0, 1]; ask for a part of full speed")
        self.cell, self.period_s, self.rate = cell, period_s, speed
        self.ik_solver, self.speed = ik_solver, speed
        self._planner = SegmentPlanner(cell, period_s)
        self.links = CellLinks(cell)
        self._arms: Sequence[Arm] = self.links.arms
        self._has_remote_centres = all(entry.arm.has_remote_centre for entry in cell.arms)
        self._bases = [entry.T_task_base[:3].tolist() for entry in cell.arms]
        self._iks = [
            IkSolver.for_arm(arm, port=_port(entry), solver=ik_solver, damping=_damping(arm))
            for arm, entry in zip(self._arms, cell.arms, strict=True)
        ]
        self._reference: tuple[AxisMotion, ...] = ()
        self._in_phase: tuple[AxisMotion, ...] = ()  # the same by the time of the motion
        self._rate_change = 0.0
        # joints, mean velocities over the last period, velocities at its end
        self._commanded: list[tuple[Joints, Joints, Joints]] = []
        self._motion: Motion | None = None
        self._phase, self._fault = 0.0, ""
        self._brake: Segment | None = None
        self._ends_at_rest = True

    def start(self, state: CellState) -> None:
        """Stands still at the setpoints that the driver holds."""
        self.place(
            tuple(AxisMotion.at_rest((*a.setpoint_jp, a.jaw_setpoint_jp)) for a in state.arms)
        )
        self._motion, self._phase, self._fault = None, 0.0, ""
        self.rate, self._rate_change = self.speed, 0.0

    @property
    def arrived(self) -> bool:
        """Whether the present motion is over and the next one is due."""
        if self._fault:
            return False
        return self._motion is None or self._phase >= self._motion.duration_s - PHASE_TOLERANCE

    @property
    def remaining_s(self) -> float:
        """Time until the present motion is over, at the present rate."""
        if self._fault:
            return math.inf
        if self._motion is None:
            return 0.0
        return max(self._motion.duration_s - self._phase, 0.0) / self.rate

    def coming(self) -> Coming | None:
        """For planning ahead: where the next segment starts; None when that is not known."""
        if self._motion is None or self.arrived or not self._has_remote_centres:
            return None
        return self._coming(self._motion.at(self._motion.duration_s))

    def _coming(self, start: tuple[AxisMotion, ...]) -> Coming:
        links = copy.copy(self.links)  # its turns become the line's when the segment is begun
        links.turns = list(links.turns)
        return Coming(start, links, self._planner)

    def go_to(self, waypoint: Waypoint, last: bool = False, coming: Coming | None = None) -> float:
        """Begins the segment to a waypoint; returns its stretch.

        A waypoint that cannot be reached leaves the line without setpoints, which the gate
        answers with a stop (S16).

        Args:
            waypoint: where the tips shall be.
            last: the motion ends at rest there.
            coming: the same segment, planned ahead; it counts where the line is at its start.
        """
        if not self._has_remote_centres:
            self.fail(
                "going from waypoint to waypoint needs a remote centre by mechanism; make a plan "
                "of the whole path"
            )
            return 1.0
        start = self._present()
        if coming is None or not _are_same(coming.start, start):
            coming = self._coming(start)
        try:
            segment = coming.segment or coming.plan(waypoint, last)
        except (ViskillError, ValueError) as error:
            self.fail(str(error))
            return 1.0
        self.links.turns = coming.links.turns
        self.follow(segment)
        return segment.stretch

    @property
    def motion(self) -> Motion | None:
        """What the line follows at present."""
        return self._motion

    @property
    def setpoints(self) -> tuple[JointSetpoint, ...]:
        """What the line has asked for last."""
        return tuple(
            JointSetpoint(q, end, motion.p[-1], motion.v[-1])
            for (q, _, end), motion in zip(self._commanded, self._reference, strict=True)
        )

    @property
    def phase(self) -> float:
        """Time of the present motion, s."""
        return self._phase

    @property
    def fault(self) -> str:
        """Why the line asks for nothing; "" while it has something to ask for."""
        return self._fault

    def fail(self, reason: str) -> None:
        """Leaves the gate without setpoints from now on: it stops the arms (S16)."""
        self._fault = reason

    def follow(self, motion: Motion) -> None:
        """Begins a motion that starts where the line is now."""
        self._motion, self._phase, self._brake = motion, 0.0, None
        end = motion.at(motion.duration_s)
        self._ends_at_rest = all(abs(v) <= AT_REST for m in end for v in m.v)

    def halt(self) -> None:
        """Comes to rest from where the line is now, jerk-limited, wherever that leads."""
        self.follow(self._planner.brake(self._present()))

    def request(
        self, now: float, waypoint: Waypoint | None = None, holding: tuple[bool, ...] = ()
    ) -> Request:
        """What to ask the gate for: the setpoints at the end of the coming period.

        Args:
            now: driver's clock, s.
            waypoint: where the line is going; says which jaws may open.
            holding: per arm, whether its jaw holds something.
        """
        if self._fault:
            return Request(None, failure=self._fault)
        due = math.inf
        reference = self.sample()
        if self._motion is not None and not self._ends_at_rest:
            due = now + (self._motion.duration_s - self._phase) / self.rate
        may_open, seen = (waypoint.may_open_jaw, waypoint.observation) if waypoint else ((), ())
        return self.resolved(reference, due, may_open, holding, seen)

    def resolved(
        self,
        reference: tuple[AxisMotion, ...],
        due: float = math.inf,
        may_open: tuple[bool, ...] = (),
        holding: tuple[bool, ...] = (),
        observation: tuple[float, ...] = (),
    ) -> Request:
        """The request for smoothed states of all arms: each goes once more through its QP."""
        try:
            goals = [_goal(arm, m.p[:-1]) for arm, m in zip(self._arms, reference, strict=True)]
            commanded = [
                self._tick(i, goal, m)
                for i, (goal, m) in enumerate(zip(goals, reference, strict=True))
            ]
        except KinematicsError as error:
            return Request(None, failure=str(error))
        self._commanded, self._reference = commanded, reference
        tips = tuple(map(_in_task, self._bases, goals))
        return Request(self.setpoints, "", due, may_open, holding, observation, tips)

    def place(self, reference: tuple[AxisMotion, ...]) -> None:
        """Takes a moving state of all arms for what was commanded last."""
        self._reference = self._in_phase = reference
        self._commanded = [(m.p[:-1], m.v[:-1], m.v[:-1]) for m in reference]

    def advance(self, speed_scale: float) -> None:
        """Lets the time base run for one period, as fast as the gate agrees to."""
        self._phase += self.period_s * self.rate
        full, slowest = self.speed, SLOWEST * self.speed
        goal = max(self.rate * speed_scale, slowest) if speed_scale < 1.0 else full
        away, bend = goal - self.rate, RATE_BEND_PER_S2 * self.period_s
        # Even steps down to no change, none larger than a bend, that end where the goal is reached.
        steps = math.ceil(math.sqrt(0.25 + 2.0 * abs(away) / (bend * self.period_s)) - 0.5)
        change = 2.0 * abs(away) / (self.period_s * (steps + 1))
        wish = math.copysign(min(change, RATE_CHANGE_PER_S), away) - self._rate_change
        self._rate_change += min(max(wish, -bend), bend)
        self.rate = min(max(self.rate + self._rate_change * self.period_s, slowest), full)

    def sample(self) -> tuple[AxisMotion, ...]:
        """Smoothed state of every arm at the end of the coming period."""
        if self._motion is None:
            return self._reference
        r = self.rate
        time = self._phase + self.period_s * r
        sampled = self._motion.at(time)
        over = time - self._motion.duration_s
        if over > PHASE_TOLERANCE:
            # A part of a period is left, or the next waypoint is late: come to rest, jerk-limited.
            # The next segment starts from wherever that has led to.
            if self._brake is None:
                self._brake = self._planner.brake(sampled)
            sampled = self._brake.at(over)
        self._in_phase = sampled
        if r == 1.0:
            return sampled
        return tuple(
            AxisMotion(m.p, tuple(r * x for x in m.v), tuple(r * r * x for x in m.a))
            for m in sampled
        )

    def _tick(self, index: int, goal: pin.SE3, motion: AxisMotion) -> tuple[Joints, Joints, Joints]:
        """One QP: joints of an arm at the end of the period, velocities over it and at its end."""
        q, v, _ = self._commanded[index]
        if self._arms[index].description.has_remote_centre:
            solution = self._iks[index].step(q, v, goal, self.period_s)
            return solution.q, solution.v, self._end_velocity(solution.q, motion)
        # What the task leaves open stays near the segment; the port takes the joints off it, so
        # the speed at the end is known from their own last steps.
        wish = [(p - now) / self.period_s for p, now in zip(motion.p, q, strict=False)]
        solution = self._iks[index].step(q, v, goal, self.period_s, v_preferred=wish)
        end = tuple([1.5 * new - 0.5 * old for new, old in zip(solution.v, v, strict=True)])
        return solution.q, solution.v, end

    def _end_velocity(self, q: Joints, motion: AxisMotion) -> Joints:
        """Velocities at the end of the period, which the servo is fed; the QP knows the mean."""
        dt = self.period_s
        return tuple([v + (a - b) / dt for v, a, b in zip(motion.v, q, motion.p, strict=False)])

    def _present(self) -> tuple[AxisMotion, ...]:
        """Where the next segment starts: the reference, unless the QP was held back from it.

        By the time of the motion, which is slower than the clock's while the rate is below 1.
        """
        motions = []
        for motion, (q, v, _) in zip(self._in_phase, self._commanded, strict=True):
            gap = max(abs(a - b) for a, b in zip(motion.p, q, strict=False))
            if gap > OFF_REFERENCE:
                rest, along = (0.0,) * len(motion.p), [x / self.rate for x in v]
                motions.append(AxisMotion((*q, motion.p[-1]), (*along, motion.v[-1]), rest))
            else:
                motions.append(motion)
        return tuple(motions)


def _are_same(one: tuple[AxisMotion, ...], other: tuple[AxisMotion, ...]) -> bool:
    """Whether two states of all arms are the same but for rounding."""
    return all(
        abs(x - y) <= ROUNDING
        for a, b in zip(one, other, strict=True)
        for x, y in zip((*a.p, *a.v, *a.a), (*b.p, *b.v, *b.a), strict=True)
    )


def _in_task(base: list[list[float]], T_base_tip: pin.SE3) -> Joints:
    """Origin of a pose given in an arm's base, task frame, m."""
    x, y, z = T_base_tip.translation.tolist()
    return tuple([a * x + b * y + c * z + d for a, b, c, d in base])


def _goal(arm: Arm, q: Joints) -> pin.SE3:
    """Where the tip shall be: where the joints bring it, and with its shaft in the port."""
    pose = arm.forward(q)
    return arm.aimed(pose) if isinstance(arm, StraightArm) else pose


def _damping(arm: Arm) -> float:
    """Of the QP: what settles an elbow that is free, where there is one."""
    return LEAST if arm.description.has_remote_centre else DAMPING


def _port(entry: CellArm) -> PortConstraint | None:
    """The remote-centre rows; none where the port is the mechanical centre and they are 0 = 0."""
    if entry.arm.has_remote_centre and not entry.port_in_base.any():
        return None
    return PortConstraint(entry.port_in_base, SHAFT_FRAME, np.array([0.0, 0.0, 1.0]))
