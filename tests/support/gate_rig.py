"""A cell on a fake clock: ideal arms that do what the gate sends, and knobs to break them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from typing import Any

from viskill_deploy.core.description import CellArm, CellDescription, load_cell
from viskill_deploy.core.types import (
    PSM_JOINTS,
    Action,
    ArmState,
    CellState,
    Inputs,
    Joints,
    JointSetpoint,
    Mode,
    Request,
    Verdict,
)
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.decision import Decision
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.safety.rule_base import Rule, find_rules
from viskill_deploy.safety.supervisor import Supervisor

PERIOD = 0.004
CELL = load_cell("bipegtransfer")
RULES = {rule.id: rule for rule in find_rules()}


def home(cell_arm: CellArm) -> Joints:
    """Joints that put the control point where the cell's file starts, wrist straight."""
    T, p = cell_arm.T_task_base, cell_arm.entry.start_position_m
    x, y, z = (float(T[:3, i] @ (p - T[:3, 3])) for i in range(3))
    r = math.hypot(x, y, z)
    depth = r - cell_arm.arm.wrist_offset_m - cell_arm.arm.joints[5].a_m
    return (math.atan2(x, -z), math.asin(-y / r), depth, 0.1, 0.0, 0.0)


class Rig:
    """One supervisor with its cell."""

    def __init__(self, period: float = PERIOD, cell: CellDescription | None = None) -> None:
        self.cell = cell or CELL
        self.period = period
        self.gate = Supervisor(self.cell, period)
        self.now, self.ticks = 1.0, 0
        self.consent, self.estop = False, False
        self.watchdog_s: float | None = None  # None: it looks in every cycle
        self.watchdog_stepped_in = False
        self.held = tuple(JointSetpoint(home(a), (0.0,) * 6, 0.3, 0.0) for a in self.cell.arms)
        self.before = self.older = self.held
        self.broken: dict[int, dict[str, Any]] = {}
        self.said: dict[str, Any] = {}

    def state(self) -> CellState:
        """What the driver says now; `broken` replaces fields of an arm, `said` of the inputs."""
        wobble = 1e-9 * (self.ticks % 7)
        arms = []
        for index, (cell_arm, held) in enumerate(zip(self.cell.arms, self.held, strict=True)):
            arm = ArmState(
                name=cell_arm.name,
                stamp_s=self.now,
                valid=True,
                operating_state="ENABLED",
                is_homed=True,
                is_busy=False,
                measured_jp=tuple(q + wobble for q in held.jp),
                measured_jv=held.jv,
                jaw_measured_jp=held.jaw,
                jaw_measured_jv=held.jaw_v,
                setpoint_jp=held.jp,
                jaw_setpoint_jp=held.jaw,
                joint_names=PSM_JOINTS,
                tool=cell_arm.arm.tool,
            )
            arms.append(replace(arm, **self.broken.get(index, {})))
        watch = self.now if self.watchdog_s is None else self.watchdog_s
        inputs = Inputs(
            self.consent, self.now, "simulated", self.estop, watch, self.watchdog_stepped_in
        )
        return CellState(tuple(arms), replace(inputs, **self.said))

    def arm(self) -> tuple[Verdict, ...]:
        """From OFF to ARMED as an operator would do it."""
        self.consent = False
        self.gate.connect(self.state())
        self.consent = True
        return self.gate.arm(self.state(), self.now)

    def ask(
        self, setpoints: tuple[JointSetpoint, ...] | None, dt: float | None = None, **request: Any
    ) -> Decision:
        """One cycle later, asks for setpoints; ideal arms take what the gate sends."""
        self.now += self.period if dt is None else dt
        self.ticks += 1
        decision = self.gate.check(self.state(), Request(setpoints, **request), self.now)
        self.older, self.before = self.before, self.held
        if decision.setpoints:
            self.held = tuple(checked.setpoint for checked in decision.setpoints)
        return decision

    def stay(self) -> tuple[JointSetpoint, ...]:
        """Setpoints that ask to stay where the arms are."""
        return tuple(JointSetpoint(held.jp, (0.0,) * 6, held.jaw, 0.0) for held in self.held)

    def going_on(self) -> tuple[JointSetpoint, ...]:
        """Setpoints that go on with the last step of every joint; acceleration fades, smoothly."""
        setpoints = []
        for index, arm in enumerate(self.gate.envelope.arms):
            a, b, c = (
                (*row[index].jp, row[index].jaw) for row in (self.older, self.before, self.held)
            )
            turns = [0.9 * jerk * self.period**3 for jerk in arm.max_jerk]
            bends = [z - 2.0 * y + x for x, y, z in zip(a, b, c, strict=True)]
            fading = [
                math.copysign(max(abs(bend) - turn, 0.0), bend)
                for bend, turn in zip(bends, turns, strict=True)
            ]
            q = [2.0 * z - y + bend for y, z, bend in zip(b, c, fading, strict=True)]
            setpoints.append(JointSetpoint(tuple(q[:6]), self.held[index].jv, q[6], 0.0))
        return tuple(setpoints)

    def moved(self, arm: int, joint: int, by: float) -> tuple[JointSetpoint, ...]:
        """The setpoints held, one joint (6: jaw) of one arm displaced."""
        setpoints = list(self.stay())
        old = setpoints[arm]
        if joint == 6:
            setpoints[arm] = replace(old, jaw=old.jaw + by)
        else:
            jp = tuple(q + by * (i == joint) for i, q in enumerate(old.jp))
            setpoints[arm] = replace(old, jp=jp)
        return tuple(setpoints)

    def run(self, cycles: int = 3) -> None:
        """Stands still in RUNNING for some cycles."""
        for _ in range(cycles):
            assert self.ask(self.stay()).passed

    def speeds(
        self, joint: int, top: float, start: float = 0.0, share: float = 0.45
    ) -> Iterator[float]:
        """Speeds of a joint, cycle by cycle, from `start` to `top` and then for ever `top`.

        Acceleration and jerk stay under `share` and twice `share` of the arm's limits.
        """
        arm = self.gate.envelope.arms[0]
        most, bend = share * arm.max_acceleration[joint], 2.0 * share * arm.max_jerk[joint]
        speed, acceleration = start, 0.0
        while abs(top - speed) > 1e-12:
            # Even steps down to no acceleration that end at the top, as the line's time base does.
            unit = bend * self.period
            steps = math.ceil(math.sqrt(0.25 + 2.0 * abs(top - speed) / (unit * self.period)) - 0.5)
            wish = 2.0 * (top - speed) / (self.period * (steps + 1))
            wish = min(max(wish, -most), most)
            acceleration += min(max(wish - acceleration, -unit), unit)
            speed += acceleration * self.period
            yield speed
        while True:
            yield top

    def swing(self, cycles: int, joint: int = 2, top: float = 0.04) -> Decision:
        """Brings one joint of the first arm gently to a speed and keeps it."""
        for speed in islice(self.speeds(joint, top), cycles):
            decision = self.ask(self.moved(0, joint, -speed * self.period))
            assert decision.passed, decision.verdicts
        return decision

    def rest(self, limit: int = 200, **request: Any) -> list[Decision]:
        """Cycles until the gate's own stop has ended."""
        decisions = []
        for _ in range(limit):
            decisions.append(self.ask(self.stay(), **request))
            if decisions[-1].at_rest:
                return decisions
        raise AssertionError("the stop did not end")

    @staticmethod
    def running() -> Rig:
        """A rig in RUNNING."""
        rig = Rig()
        assert rig.arm() == ()
        rig.run()
        assert rig.gate.mode is Mode.RUNNING
        return rig


def asking(
    arm: int,
    joint: int,
    q: float,
    step: float = 0.0,
    step_before: float = 0.0,
    bend_before: float = 0.0,
) -> tuple[Cycle, CellEnvelope]:
    """A cycle in which one joint is asked to be at `q` after `step`, having moved `step_before`.

    `bend_before` is the difference between `step_before` and the step before that.
    """
    rig = Rig()
    envelope = rig.gate.envelope
    cycle = Cycle(envelope)
    cycle.begin(rig.state(), Request(rig.stay(), holding=(False, False)), rig.now)
    cycle.is_first = False
    for track, setpoint in zip(cycle.tracks, rig.stay(), strict=True):
        track.begin(setpoint)
    track, old = cycle.tracks[arm], rig.held[arm]
    places = [*old.jp, old.jaw]
    places[joint] = q - step
    track.begin(JointSetpoint(tuple(places[:6]), (0.0,) * 6, places[6], 0.0))
    track.step[joint], track.bend[joint] = step_before, bend_before
    places[joint] = q
    asked = JointSetpoint(tuple(places[:6]), (0.0,) * 6, places[6], 0.0)
    for other in cycle.tracks:
        other.ask(asked if other is track else other.sent)
    cycle.request = Request(tuple(t.asked for t in cycle.tracks), holding=(False, False))
    return cycle, envelope


def words(rule: Rule, cycle: Cycle) -> list[Verdict]:
    """What a rule says; its margin and its verdicts have to agree."""
    margin = rule.margin(cycle)
    verdicts = list(rule.judge(cycle)) if not margin >= 0.0 else []
    assert (margin >= 0.0) == (not verdicts)
    return verdicts


def worst(verdicts: list[Verdict]) -> Action:
    """The severest action of some verdicts."""
    return max((verdict.action for verdict in verdicts), default=Action.PASS)
