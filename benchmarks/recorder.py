"""Cost of the recorder per two-arm cycle: `python benchmarks/recorder.py [cycles]`.

One core (`taskset -c 0`) is the hard case: runtime and recorder share it. Between two cycles the
benchmark works for as long as a simulated tick takes, so that the pipe is fed at a real pace.
"""

from __future__ import annotations

import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.types import (
    PSM_JOINTS,
    Action,
    ArmState,
    CellState,
    Inputs,
    JointSetpoint,
    Mode,
    Request,
)
from viskill_deploy.observe.recording import Recorder

PERIOD_S = 0.004
TICK_S = 500e-6


def inputs(cell: CellDescription, cycles: int) -> list[tuple[CellState, Request]]:
    """Smooth motion of every arm, with the noise of an encoder."""
    rng = np.random.default_rng(0)
    time_s = np.arange(cycles) * PERIOD_S
    made = []
    phases = np.arange(6) * 0.7
    for now in time_s:
        q = tuple((0.3 * np.sin(now + phases) + rng.normal(scale=1e-6, size=6)).tolist())
        v = tuple((0.3 * np.cos(now + phases)).tolist())
        arms = tuple(
            ArmState(
                arm.name, float(now), True, "ENABLED", True, False, q, v, 0.1, 0.0, q, 0.1,
                PSM_JOINTS, arm.arm.tool,
            )
            for arm in cell.arms
        )  # fmt: skip
        setpoints = tuple(JointSetpoint(q, v, 0.1, 0.0) for _ in cell.arms)
        made.append(
            (CellState(arms, Inputs(True, float(now), "simulated", False)), Request(setpoints))
        )
    return made


def main(cycles: int) -> None:
    """Records `cycles` and prints what they cost."""
    cell = load_cell("bipegtransfer")
    prepared = inputs(cell, cycles)
    pose = np.eye(4)
    cost = np.empty(cycles)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "bag"
        began = time.perf_counter()
        with Recorder(path, cell, PERIOD_S) as recorder:
            for index, (state, request) in enumerate(prepared):
                now, sent = index * PERIOD_S, request.setpoints
                start = time.perf_counter()
                recorder.cycle(
                    now, state, request, sent or (), Action.PASS, (), Mode.RUNNING, (pose, pose)
                )
                if not recorder.alive:
                    raise SystemExit("the recorder failed")
                cost[index] = time.perf_counter() - start
                while time.perf_counter() - start < TICK_S:
                    pass
            ran = time.perf_counter() - began
        closing = time.perf_counter() - began - ran
        size = sum(file.stat().st_size for file in path.iterdir())
    child = resource.getrusage(resource.RUSAGE_CHILDREN)
    cost *= 1e6
    print(f"runtime, us a cycle: median {np.median(cost):.1f}, p99 {np.percentile(cost, 99):.1f}")
    print(f"recorder, cpu us a cycle: {1e6 * (child.ru_utime + child.ru_stime) / cycles:.1f}")
    print(f"whole cycle {1e6 * ran / cycles:.0f} us, of which {1e6 * TICK_S:.0f} us are work")
    print(f"bag: {size / cycles:.0f} bytes a cycle; closed in {closing:.2f} s")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 20_000)
