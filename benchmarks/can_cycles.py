"""Cycles of 14 CiA 402 axes on two buses in one process, against the clock.

    python benchmarks/can_cycles.py [--seconds 60] [--hz 400] [--priority 50] [--check]

Driver, gate and drives take turns in one thread on `virtual` buses: in every period the runtime
reads all drives, puts a swinging setpoint of both arms before the gate, sends controlwords, targets
and SYNC, and the drives answer. The arms are ideal: what costs time is CAN and the gate. A cycle is
missed when its SYNC goes out after that of the next was due, or when a drive leaves one unanswered;
`machine_was_away` of them because the system woke the thread late or took the processor from it,
which a loop that does nothing meets as well (`bare_loop`). `--check` exits with 1 when a cycle was
missed for another reason.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import threading
import time
from dataclasses import replace
from typing import Any

import numpy as np

from viskill_deploy.core import realtime
from viskill_deploy.core.clock import MonotonicClock
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.types import Action, JointSetpoint, Request
from viskill_deploy.drivers.can.codec import HEARTBEAT_ID, TPDO_ID
from viskill_deploy.drivers.can.config import INPUT_PERIOD_S, CanFile, load_can
from viskill_deploy.drivers.can.driver import CanDriver
from viskill_deploy.drivers.can.inputs import pack_input
from viskill_deploy.drivers.can.line import CanLine
from viskill_deploy.drivers.can.simulated_cell import ArmOfDrives
from viskill_deploy.safety.supervisor import Supervisor
from viskill_deploy.sim.world import World

CELL = load_cell("bipegtransfer")
AWAY_S = 0.001
"""A free machine neither wakes a thread of the first rank later, nor takes so much from it."""

SWING_RAD, SWING_S = 0.02, 2.0


class IdealArms(MonotonicClock):
    """Drives that are where they are told to be. They take their turn when the driver sleeps."""

    def __init__(self, file: CanFile) -> None:
        self.file, self.consent, self._words = file, False, 0
        self._thread = threading.get_ident()
        lines = [CanLine(bus.arm, file.interface, bus.channel) for bus in file.bus]
        self.arms = [
            ArmOfDrives(arm, bus, line)
            for arm, bus, line in zip(CELL.arms, file.bus, lines, strict=True)
        ]
        for arm, home in zip(self.arms, World(CELL).home.tolist(), strict=True):
            for drive, count in zip(arm.drives, arm.gearing.counts(home), strict=True):
                drive.actual = count
        self._ticked_s = self._word_due_s = self._beat_due_s = self.now()

    def sleep_until(self, deadline_s: float) -> float:
        """Sleeps; in the thread of the drives, after they have had their turn."""
        if threading.get_ident() == self._thread:
            self.turn()
        return super().sleep_until(deadline_s)

    def turn(self) -> None:
        """Hears, answers, moves."""
        now = self.now()
        for arm in self.arms:
            arm.poll(now)
            arm.tick(now, now - self._ticked_s)
            for drive in arm.drives:
                drive.actual = round(drive.demand)
        self._ticked_s = now
        self._say(now)

    def _say(self, now: float) -> None:
        node, line = self.file.input.node_id, self.arms[0].line
        if now >= self._beat_due_s:
            self._beat_due_s = now + self.file.heartbeat_s
            line.send(HEARTBEAT_ID + node, b"\5")
        if now >= self._word_due_s:
            self._word_due_s, self._words = now + INPUT_PERIOD_S, self._words + 1
            line.send(TPDO_ID + node, pack_input(self.consent, False, self._words))


def armed(driver: CanDriver, drives: IdealArms) -> Supervisor:
    driver.clock = drives
    driver.connect()
    driver.enable()
    driver.home()
    gate = Supervisor(CELL, driver.period_s)
    for consent in (False, True):
        drives.consent = consent
        for _ in range(30):
            drives.sleep_until(drives.now() + driver.period_s)
            driver.keep()
            state = driver.state()
            gate.connect(state)
    against = gate.arm(state, drives.now())
    assert not against, against
    return gate


def run(file: CanFile, seconds: float, priority: int) -> dict[str, Any]:
    """Figures of one run; times in microseconds."""
    drives = IdealArms(file)
    driver = CanDriver(CELL, file)
    refused = realtime.prepare(priority)
    gate, period = armed(driver, drives), driver.period_s
    rest = [
        JointSetpoint(a.setpoint_jp, (0.0,) * 6, a.jaw_setpoint_jp, 0.0)
        for a in driver.state().arms
    ]
    count = round(seconds / period)
    syncs, busy, late, woke, taken = (np.empty(count) for _ in range(5))
    unanswered = 0
    driver.watch.beat(drives.now())  # from here on nobody else sends
    drives.turn()
    deadline = drives.now()
    for tick in range(count):
        deadline += period
        woke[tick] = MonotonicClock.sleep_until(drives, deadline) - deadline
        began, worked = time.perf_counter(), time.thread_time()
        state = driver.state()
        wish = tuple(swung(setpoint, tick * period) for setpoint in rest)
        decision = gate.check(state, Request(wish), drives.now())
        assert decision.action < Action.HOLD, decision.verdicts
        driver.servo_jp(decision.setpoints)
        driver.watch.beat(drives.now())
        syncs[tick] = drives.now()
        late[tick] = syncs[tick] - deadline
        drives.turn()
        unanswered += sum(axis.unanswered > 1 for master in driver.masters for axis in master.axes)
        busy[tick] = time.perf_counter() - began
        taken[tick] = busy[tick] - (time.thread_time() - worked)
        if late[tick] > period:
            deadline = drives.now()  # what is lost is not caught up on
    realtime.release()
    driver.close()
    for arm in drives.arms:
        arm.line.close()
    missed = late > period
    return {
        "hz": file.cycle_hz,
        "axes": sum(len(bus.axis) for bus in file.bus),
        "load": driver.load,
        "cycles": count,
        "missed": int(missed.sum()),
        "machine_was_away": int((missed & (np.maximum(woke, taken) > AWAY_S)).sum()),
        "unanswered": unanswered,
        "outside_the_window": driver.late,
        "sync_to_sync_us": percentiles(np.diff(syncs)),
        "woke_late_us": percentiles(woke),
        "busy_us": percentiles(busy),
        "refused_by_the_system": refused,
    }


def bare_loop(hz: float, seconds: float, priority: int) -> dict[str, object]:
    """How late the machine wakes a thread that only sleeps."""
    clock, count = MonotonicClock(), round(seconds * hz)
    woke = np.empty(count)
    realtime.prepare(priority)
    deadline = clock.now()
    for tick in range(count):
        deadline += 1.0 / hz
        woke[tick] = clock.sleep_until(deadline) - deadline
        if woke[tick] > 1.0 / hz:
            deadline = clock.now()
    realtime.release()
    return {"overslept": int((woke > AWAY_S).sum()), "woke_late_us": percentiles(woke)}


def swung(rest: JointSetpoint, time_s: float) -> JointSetpoint:
    """Every joint about its place, from rest; the amplitude grows in the first seconds."""
    w = 2 * math.pi / SWING_S
    grown = min(time_s / 4.0, 1.0)
    size = SWING_RAD * grown**3 * (10 - 15 * grown + 6 * grown**2)
    scale = (1.0, 1.0, 0.1, 1.0, 1.0, 1.0)
    angle = size * math.sin(w * time_s)
    speed = size * w * math.cos(w * time_s)
    jp = tuple(q + s * angle for q, s in zip(rest.jp, scale, strict=True))
    return replace(rest, jp=jp, jv=tuple(s * speed for s in scale))


def percentiles(values: np.ndarray) -> dict[str, float]:
    named = {"p50": 50, "p90": 90, "p99": 99, "p99.9": 99.9, "max": 100}
    return {name: round(float(np.percentile(values, p)) * 1e6, 1) for name, p in named.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--hz", type=float, default=400.0)
    parser.add_argument("--priority", type=int, default=realtime.PRIORITY, help="of SCHED_FIFO")
    parser.add_argument("--check", action="store_true")
    args = parser.parse_args()
    file = load_can("bipegtransfer", CELL)
    file = CanFile.model_validate(file.model_dump(by_alias=True) | {"cycle_hz": args.hz})
    figures = run(file, args.seconds, args.priority)
    figures["bare_loop"] = bare_loop(args.hz, args.seconds, args.priority)
    print(json.dumps(figures, indent=2))
    own = figures["missed"] - figures["machine_was_away"] + figures["unanswered"]
    sys.exit(args.check and own > 0)


if __name__ == "__main__":
    main()
