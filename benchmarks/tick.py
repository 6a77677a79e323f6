"""What one control period of two arms costs, against pink on the same arm and targets, in one run.

    python benchmarks/tick.py [--ticks N] [--repeats R] [--check]

Every row is measured in short batches, rows taking turns, and the median over all batches is
printed, so that another program on the machine disturbs all rows alike. `--check` exits with 1
when a ratio that the project promises is missed.
"""

from __future__ import annotations

import argparse
import statistics
import struct
import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pink

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.types import CellState, Request
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.kinematics.arm import Arm
from viskill_deploy.kinematics.ik import IkSolver
from viskill_deploy.motion.smoothing import AxisMotion, Segment
from viskill_deploy.motion.waypoints import ActionSpec, apply_action, start_waypoint
from viskill_deploy.runtime.line import Line
from viskill_deploy.safety.supervisor import Supervisor

PERIOD_S = 0.004
BATCH = 50
EMPTY = (False, False)
PACK = struct.Struct("<28d")

Motions = list[tuple[AxisMotion, ...]]


def motions(ticks: int) -> tuple[Motions, Segment]:
    """Smoothed states of both arms, tick by tick, of a policy that wanders; and one segment."""
    cell = load_cell("bipegtransfer")
    driver = LoopbackDriver(cell)
    driver.connect()
    line = Line(cell, PERIOD_S)
    line.start(driver.state())
    rng = np.random.default_rng(0)
    waypoint = start_waypoint(cell)
    rows: Motions = [line.sample()]
    while len(rows) < ticks:
        action = rng.uniform(-1, 1, 10) * np.array([1, 1, 1, 0.2, 1] * 2)
        action[[4, 9]] = 1.0
        waypoint = apply_action(waypoint, action, waypoint.T_task_tip, cell, ActionSpec())
        line.go_to(waypoint)
        segment = line.motion
        assert isinstance(segment, Segment)
        while not line.arrived:
            rows.append(line.sample())
            line.resolved(rows[-1])
            line.advance(1.0)
    return rows[:ticks], segment


class Rows:
    """The things that are measured; each call does one tick of both arms."""

    def __init__(self, ticks: int) -> None:
        self.cell = load_cell("bipegtransfer")
        self.motions, self.segment = motions(ticks)
        self.arms = [Arm(entry.arm) for entry in self.cell.arms]
        self.poses = [
            [arm.forward(m.p[:6]) for arm, m in zip(self.arms, row, strict=True)]
            for row in self.motions
        ]
        self.iks = [IkSolver.for_arm(arm) for arm in self.arms]
        self.line = Line(self.cell, PERIOD_S)
        self.setpoints = [tuple(m.setpoint() for m in row) for row in self.motions]
        self._prepare_pink()

    def _prepare_pink(self) -> None:
        self.pink = []
        for arm in self.arms:
            model = arm.model.copy()
            data = model.createData()
            configuration = pink.Configuration(model, data, np.array(self.motions[0][0].p[:6]))
            task = pink.FrameTask("tip", position_cost=1.0, orientation_cost=1.0)
            self.pink.append((configuration, task))

    def begin(self) -> None:
        """Puts everything that has a memory at the start of the motion, at rest."""
        first = self.motions[0]
        for (configuration, _), m in zip(self.pink, first, strict=True):
            configuration.update(np.array(m.p[:6]))
        self.commanded = [(m.p[:6], m.v[:6]) for m in first]
        self.line.place(first)
        driver = LoopbackDriver(self.cell)
        driver.connect()
        driver.enable()
        driver.home()
        refused = self._at(driver.state(), 0)
        driver.say(consent=True)
        agreed = replace(refused, inputs=driver.state().inputs)
        self.gates = [Supervisor(self.cell, PERIOD_S) for _ in range(2)]
        for gate in self.gates:
            gate.connect(refused)
            against = gate.arm(agreed, self._now(0))
            assert not against, against
        self.states = [self._at(agreed, t) for t in range(len(self.motions))]

    def _now(self, tick: int) -> float:
        return 1.0 + PERIOD_S * tick

    def _at(self, state: CellState, tick: int) -> CellState:
        arms = tuple(
            replace(
                arm,
                stamp_s=self._now(tick),
                measured_jp=m.p[:6],
                measured_jv=m.v[:6],
                jaw_measured_jp=m.p[6],
                setpoint_jp=m.p[:6],
                jaw_setpoint_jp=m.p[6],
            )
            for arm, m in zip(state.arms, self.motions[tick], strict=True)
        )
        now = self._now(tick)
        inputs = replace(state.inputs, consent_stamp_s=now, watchdog_stamp_s=now)
        return replace(state, arms=arms, inputs=inputs)

    def pink_ik(self, tick: int) -> None:
        """Pink's solve_ik with configuration and velocity limits, and its integration."""
        for (configuration, task), pose in zip(self.pink, self.poses[tick + 1], strict=True):
            task.set_target(pose)
            velocity = pink.solve_ik(configuration, [task], PERIOD_S, solver="daqp")
            configuration.integrate_inplace(velocity, PERIOD_S)

    def qp_ik(self, tick: int) -> None:
        """Our QP with position, velocity and acceleration limits and its checks."""
        for i, pose in enumerate(self.poses[tick + 1]):
            q, v = self.commanded[i]
            solution = self.iks[i].step(q, v, pose, PERIOD_S)
            self.commanded[i] = (solution.q, solution.v)

    def closed_form(self, tick: int) -> None:
        """Our closed form, joint limits and roll turn included."""
        for i, pose in enumerate(self.poses[tick + 1]):
            self.arms[i].inverse(pose, self.commanded[i][0])

    def ruckig(self, tick: int) -> None:
        """Sampling both arms' smoothed segments."""
        self.segment.at((tick % 50) * PERIOD_S)

    def pack(self, tick: int) -> None:
        """Both arms' setpoints as bytes."""
        first, second = self.setpoints[tick + 1]
        PACK.pack(
            *first.jp, first.jaw, *first.jv, first.jaw_v,
            *second.jp, second.jaw, *second.jv, second.jaw_v,
        )  # fmt: skip

    def gate_check(self, tick: int) -> None:
        """The whole gate."""
        state = self.states[tick]
        decision = self.gates[0].check(
            state, Request(self.setpoints[tick + 1], holding=EMPTY), self._now(tick)
        )
        assert decision.passed, decision.verdicts

    def whole_tick(self, tick: int) -> None:
        """Sample, resolve, gate, pack: all that a period of the runtime computes for two arms."""
        request = self.line.resolved(self.motions[tick + 1], holding=EMPTY)
        decision = self.gates[1].check(self.states[tick], request, self._now(tick))
        assert decision.passed, decision.verdicts
        first, second = (checked.setpoint for checked in decision.setpoints)
        PACK.pack(
            *first.jp, first.jaw, *first.jv, first.jaw_v,
            *second.jp, second.jaw, *second.jv, second.jaw_v,
        )  # fmt: skip


def measure(rows: Rows, ticks: int, repeats: int) -> dict[str, float]:
    """Median time of a tick for every row, us."""
    table: dict[str, Callable[[int], None]] = {
        "pink solve_ik": rows.pink_ik,
        "QP IK": rows.qp_ik,
        "closed form": rows.closed_form,
        "Ruckig": rows.ruckig,
        "pack": rows.pack,
        "gate": rows.gate_check,
        "whole tick": rows.whole_tick,
    }
    times: dict[str, list[float]] = {name: [] for name in table}
    for _ in range(repeats):
        rows.begin()
        for start in range(0, ticks - BATCH - 1, BATCH):
            for name, call in table.items():
                began = time.perf_counter_ns()
                for tick in range(start, start + BATCH):
                    call(tick)
                times[name].append((time.perf_counter_ns() - began) / BATCH / 1e3)
    return {name: statistics.median(values) for name, values in times.items()}


def main() -> int:
    """Prints the table; the exit code says whether the promised ratios hold."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ticks", type=int, default=1000)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--check", action="store_true")
    args = parser.parse_args()
    medians = measure(Rows(args.ticks), args.ticks, args.repeats)
    peer = medians["pink solve_ik"]
    print(f"two arms, {args.ticks} ticks of {PERIOD_S * 1e3:.0f} ms, median of batches of {BATCH}")
    print(f"{'':16}{'us a tick':>10}{'x pink':>9}")
    for name, value in medians.items():
        print(f"{name:16}{value:10.1f}{value / peer:9.2f}")
    line = medians["QP IK"] + medians["Ruckig"] + medians["pack"]
    promises = {
        "QP IK at least 3 times faster than pink": medians["QP IK"] * 3 <= peer,
        "QP IK + Ruckig + pack faster than pink": line < peer,
        "whole tick at most 1.5 times pink": medians["whole tick"] <= 1.5 * peer,
    }
    for text, kept in promises.items():
        print(f"{'kept  ' if kept else 'MISSED'} {text}")
    return int(args.check and not all(promises.values()))


if __name__ == "__main__":
    sys.exit(main())
