"""Brings faults about in a run on a simulated cell, and notes what the gate does about them.

Nothing here is part of a run that asks for no faults, and no other driver than a simulated one is
ever wrapped.
"""

from __future__ import annotations

import math
import os
import resource
import signal
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import pinocchio as pin

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DriverError, IkError
from viskill_deploy.core.types import (
    PSM_JOINTS,
    Action,
    Boundary,
    CellState,
    FloatArray,
    Joints,
    JointSetpoint,
    Mode,
    Request,
    Scene,
    SkillStart,
    Verdict,
)
from viskill_deploy.drivers.base import Driver
from viskill_deploy.motion.smoothing import AxisMotion
from viskill_deploy.runtime.faults import Injection
from viskill_deploy.runtime.faulty_driver import FaultyDriver
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.record import Recorder

SLOW_S = 0.08
"""What a slow policy takes longer: less than S19 allows."""

SPIKE_RAD = 0.3
"""17°: in one cycle dVRK's PID would drive it at full current."""

TRACKED = (0.05, 0.05, 0.003, 0.1, 0.1, 0.1)
"""rad, m. The fastest joint is the one that first leaves these behind it, S17's tolerances."""


@dataclass
class Struck:
    """A fault of the run and what came of it.

    Attributes:
        injection: what was asked for.
        began_s: driver's clock when it began; NaN before.
        is_over: it has ended.
        action, rules: the first thing that the gate did afterwards which was no milder than what
            is declared, HOLD or worse, and the rules that asked for it. Of several rules in one
            cycle the declared one tells the action.
        after_s: time from the beginning to then.
    """

    injection: Injection
    began_s: float = math.nan
    is_over: bool = False
    action: Action = Action.PASS
    rules: tuple[str, ...] = ()
    after_s: float = math.nan

    @property
    def has_begun(self) -> bool:
        """Whether it has begun."""
        return not math.isnan(self.began_s)

    def facts(self) -> dict[str, Any]:
        """For the figures of the run: what was declared and what was seen."""
        fault, injection = self.injection.fault, self.injection
        declared = fault.reaction
        return {
            "fault": str(injection),
            "what": fault.what,
            "began": self.has_begun,
            "declared_rule": declared.rule,
            "declared_action": declared.action.name,
            "declared_within_s": declared.within_s if declared.rule else None,
            "seen_rules": list(self.rules),
            "seen_action": self.action.name,
            "seen_after_s": self.after_s if self.rules else None,
        }


class FaultInjector:
    """All faults of one run.

    Args:
        injections: what is asked for.
        driver: of the simulated cell; the session drives `self.driver` instead.
        recorder: of the run; the session writes to `self.recorder` instead.

    Attributes:
        driver: what the session has to drive.
        recorder: what the session has to write to.
        struck: one entry a fault, in the order of `injections`.
    """

    def __init__(self, injections: Sequence[Injection], driver: Driver, recorder: Recorder) -> None:
        if not driver.capabilities.simulated:
            raise DriverError("faults are brought about on the simulated cell only")
        self.struck = [Struck(injection) for injection in injections]
        self._inner, self._first_s = driver, math.nan
        self.driver = FaultyDriver(driver, self)
        self.recorder: Recorder = WitnessingRecorder(recorder, self)
        self._fastest = (0, 0)
        self._before: list[JointSetpoint] = []
        self._starts: dict[str, Callable[[Injection], None]] = {
            "stuck": self._break_drive,
            "slip": self._break_drive,
            "estop": lambda _: driver.say(estop=True),
            "sigstop": self._pause,
            "kill-runtime": lambda _: os.kill(os.getpid(), signal.SIGKILL),
            "kill-watchdog": lambda _: self.driver.kill_watchdog(),
            "recorder-full": lambda _: fill_disk(recorder.process_id),
        }
        self._ends: dict[str, Callable[[], None]] = {
            "stuck": lambda: driver.break_drive("", "mended"),
            "slip": lambda: driver.break_drive("", "mended"),
            "estop": lambda: driver.say(estop=False),
        }

    def line(self, cell: CellDescription, ik_solver: str = "daqp", speed: float = 1.0) -> Line:
        """A line that asks for what the faults make of its requests."""
        return FaultyLine(self, cell, self._inner.period_s, ik_solver, speed)

    def elapsed_s(self) -> float:
        """Time since the first setpoint, by the driver's true clock; NaN before."""
        return self._inner.clock.now() - self._first_s

    def on(self, name: str) -> Injection | None:
        """The injection of the fault that is called so, if it acts now."""
        elapsed = self.elapsed_s()
        for entry in self.struck:
            injection = entry.injection
            # not before `update` has noted it: what the gate answers is counted from there
            if entry.has_begun and injection.fault.name == name and injection.is_on(elapsed):
                return injection
        return None

    def thinking_s(self) -> float:
        """What the policy takes longer to decide than it does by itself."""
        return math.inf if self.on("hung-policy") else SLOW_S if self.on("slow-policy") else 0.0

    def sees_setpoints(self, setpoints: Sequence[JointSetpoint]) -> None:
        """Setpoints go out: the first ones start the clock, all show which joint is fastest."""
        if math.isnan(self._first_s):
            self._first_s = self._inner.clock.now()
        ways = [
            (abs(new - old) / far, arm, joint)
            for arm, (s, before) in enumerate(zip(setpoints, self._before, strict=False))
            for joint, (new, old, far) in enumerate(zip(s.jp, before.jp, TRACKED, strict=True))
        ]
        if ways:
            self._fastest = max(ways)[1:]
        self._before = list(setpoints)

    def update(self) -> None:
        """Begins what is due and ends what is over."""
        elapsed = self.elapsed_s()
        for entry in self.struck:
            injection, name = entry.injection, entry.injection.fault.name
            if not entry.has_begun and elapsed >= injection.start_s - 1e-9:
                entry.began_s = self._inner.clock.now()
                self.recorder.mark(entry.began_s, -1, "", 0, f"fault {injection}")
                if name in self._starts:
                    self._starts[name](injection)
            over = entry.has_begun and not injection.is_on(elapsed)
            if over and not entry.is_over:
                entry.is_over = True
                if name in self._ends:
                    self._ends[name]()

    def witness(self, action: Action, verdicts: Sequence[Verdict]) -> None:
        """What the gate did in a cycle."""
        now = self._inner.clock.now()
        for entry in self.struck:
            least = max(entry.injection.fault.reaction.action, Action.HOLD)
            if entry.has_begun and not entry.rules and action >= least:
                entry.after_s = now - entry.began_s
                speaking = sorted(verdicts, key=lambda v: -v.action)
                rule = entry.injection.fault.reaction.rule
                entry.action = next((v.action for v in speaking if v.rule == rule), action)
                entry.rules = tuple({v.rule: None for v in speaking if v.action >= Action.HOLD})

    def _break_drive(self, injection: Injection) -> None:
        arm, joint = self._fastest
        name = self._inner.state().arms[arm].name
        self._inner.break_drive(f"{name}/{PSM_JOINTS[joint]}", injection.fault.name)

    def _pause(self, injection: Injection) -> None:
        """This process stands still; on a stepped cell its world goes on without it."""
        if self._inner.capabilities.stepped:
            self.driver.stand_still(injection.lasts_s)
            return
        wake = f"sleep {injection.lasts_s}; kill -CONT {os.getpid()}"
        subprocess.Popen(["sh", "-c", wake], start_new_session=True)
        os.kill(os.getpid(), signal.SIGSTOP)


def fill_disk(process_id: int) -> None:
    """From now on a process finds the disk full: it may write no byte to any file."""
    resource.prlimit(process_id, resource.RLIMIT_FSIZE, (0, 0))


class FaultyLine(Line):
    """A line whose QP fails, or whose setpoint leaps, when a fault says so."""

    def __init__(
        self,
        faults: FaultInjector,
        cell: CellDescription,
        period_s: float,
        ik_solver: str,
        speed: float,
    ) -> None:
        super().__init__(cell, period_s, ik_solver, speed)
        self._faults = faults

    def _tick(self, index: int, goal: pin.SE3, motion: AxisMotion) -> tuple[Joints, Joints, Joints]:
        if self._faults.on("infeasible"):
            raise IkError("infeasible", "the QP has no solution (fault)")
        q, v, end = super()._tick(index, goal, motion)
        if index == 0 and self._faults.on("spike"):
            q = (q[0] + SPIKE_RAD, *q[1:])
            end = (end[0] + SPIKE_RAD / self.period_s, *end[1:])
        return q, v, end


class WitnessingRecorder:
    """Hands everything on to a recorder and tells the faults what the gate did."""

    def __init__(self, recorder: Recorder, faults: FaultInjector) -> None:
        self._recorder, self._faults = recorder, faults
        self._at = (0, "", 0)

    @property
    def alive(self) -> bool:
        """Whether the record is being kept."""
        return self._recorder.alive

    @property
    def process_id(self) -> int:
        """The recorder's process."""
        return self._recorder.process_id

    def cycle(
        self,
        now: float,
        state: CellState,
        request: Request,
        sent: Sequence[JointSetpoint],
        action: Action,
        verdicts: Sequence[Verdict],
        mode: Mode,
        tip_poses: Sequence[FloatArray] | None,
    ) -> None:
        """Records one control cycle."""
        self._recorder.cycle(now, state, request, sent, action, verdicts, mode, tip_poses)
        self._faults.witness(action, verdicts)

    def scene(self, now: float, scene: Scene) -> None:
        """Records the objects."""
        self._recorder.scene(now, scene)

    def mark(
        self,
        now: float,
        episode: int,
        skill: str,
        step: int,
        note: str = "",
        start: SkillStart | None = None,
        boundary: Boundary | None = None,
    ) -> None:
        """Records where in the run this is; a fault's mark (episode -1) repeats the last place."""
        if episode >= 0:
            self._at = (episode, skill, step)
        self._recorder.mark(now, *self._at, note, start, boundary)
