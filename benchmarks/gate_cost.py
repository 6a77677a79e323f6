"""CPU time of the whole gate for one arm, while a bundle does its task on the stepped loopback.

    python benchmarks/gate_cost.py [BUNDLE] [--episodes 3] [--rules] [--check]

`in_run` is what `Supervisor.check` takes of its thread's CPU time in the loop, where IK, physics
and recording have had the caches in between; `by_itself` is the same checks once more, one after
the other. Both are divided by the number of arms. `of_the_tick` is the part of the whole control
period without the simulator. `--rules` adds the mean of every rule. `--check` exits with 1 when
`by_itself` is dearer than p50 60 us or p99.9 500 us.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from viskill_deploy.core.types import CellState, Request
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.observe.recording import Recorder
from viskill_deploy.runtime.boundaries import Job
from viskill_deploy.runtime.episodes import from_start_pose
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.preflight import Prepared, prepare
from viskill_deploy.runtime.session import Session
from viskill_deploy.safety.supervisor import Supervisor

MOST_US = {"p50": 60.0, "p99.9": 500.0}

Given = tuple[CellState, Request, float]


class Timed:
    """A function that notes the CPU time of every call, us, and what it was called with."""

    def __init__(self, function: Callable[..., Any], keep: bool = False) -> None:
        self.function, self.keep = function, keep
        self.us: list[float] = []
        self.given: list[Any] = []

    def __call__(self, *args: Any) -> Any:
        """Calls it."""
        began = time.thread_time_ns()
        answer = self.function(*args)
        self.us.append((time.thread_time_ns() - began) / 1e3)
        if self.keep:
            self.given.append(args)
        return answer


def in_run(prepared: Prepared, number: int) -> tuple[Timed, Timed, Timed, float]:
    """One episode: the gate's checks, whole cycles, and the simulator's part of these."""
    driver = LoopbackDriver(prepared.cell)
    driver.connect()
    rng = np.random.default_rng(number)
    driver.reset(prepared.task.sample_layout(rng, prepared.task.distributions[0]))
    training = prepared.bundle.manifest.training_range.seen
    line = Line(prepared.cell, driver.period_s)
    with tempfile.TemporaryDirectory() as folder, Recorder(
        Path(folder) / "recording", prepared.cell, driver.period_s
    ) as recorder, Session(prepared.cell, driver, line, recorder, training) as session:  # fmt: skip
        check, cycle = Timed(session.gate.check, keep=True), Timed(session.cycle)
        advance = Timed(driver.advance)
        session.gate.check, session.cycle, driver.advance = check, cycle, advance  # type: ignore[method-assign]
        from_start_pose(session, "closed-loop", Job(prepared.bundle, prepared.task), rng, 0)
    return check, cycle, advance, driver.period_s


def armed(prepared: Prepared, period_s: float, state: CellState, now: float) -> Supervisor:
    """A gate that has taken responsibility for the arms in this state."""
    gate = Supervisor(prepared.cell, period_s, prepared.bundle.manifest.training_range.seen)
    gate.connect(replace(state, inputs=replace(state.inputs, consent=False)))
    against = gate.arm(state, now)
    assert not against, against
    return gate


def by_itself(prepared: Prepared, period_s: float, given: list[Given]) -> Timed:
    """The checks of an episode once more, one after the other."""
    gate = armed(prepared, period_s, given[0][0], given[0][2])
    check = Timed(gate.check)
    for state, request, now in given:
        assert check(state, request, now).passed, "the gate judges otherwise than in the run"
    return check


def of_rules(prepared: Prepared, period_s: float, given: list[Given]) -> dict[str, float]:
    """Mean cost of every rule in the same checks, us for all arms; the clock's own taken off."""
    gate = armed(prepared, period_s, given[0][0], given[0][2])
    clock = Timed(lambda: None)
    for _ in range(1000):
        clock()
    own = statistics.fmean(clock.us)
    timed = {rule.id: Timed(rule.margin) for rule in gate._instances}
    for rule in gate._instances:
        rule.margin = timed[rule.id]  # type: ignore[method-assign]
    for state, request, now in given:
        gate.check(state, request, now)
    return {name: round(statistics.fmean(call.us) - own, 2) for name, call in timed.items()}


def percentiles(us: list[float]) -> dict[str, float]:
    """p50, p99 and p99.9, and the mean."""
    parts = {f"p{part:g}": float(np.percentile(us, part)) for part in (50, 99, 99.9)}
    return {name: round(value, 1) for name, value in (parts | {"mean": np.mean(us)}).items()}


def main() -> int:
    """Prints the figures; the exit code says whether the gate is as cheap as it should be."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "bundle", type=Path, nargs="?", default=Path("policies/bipegtransfer-viskill")
    )
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--rules", action="store_true")
    parser.add_argument("--check", action="store_true")
    args = parser.parse_args()
    prepared = prepare(args.bundle)
    arms = len(prepared.cell.arms)
    cold: list[float] = []
    hot: list[float] = []
    tick: list[float] = []
    for number in range(args.episodes):
        check, cycle, advance, period_s = in_run(prepared, number)
        cold += [us / arms for us in check.us]
        tick.append(sum(check.us) / (sum(cycle.us) - sum(advance.us)))
        hot += [us / arms for us in by_itself(prepared, period_s, check.given).us]
    figures: dict[str, Any] = {
        "checks": len(cold),
        "in_run_us_an_arm": percentiles(cold),
        "by_itself_us_an_arm": percentiles(hot),
        "of_the_tick": round(statistics.fmean(tick), 3),
    }
    if args.rules:
        figures["rules_us"] = of_rules(prepared, period_s, check.given)
    print(json.dumps(figures, indent=2))
    found = figures["by_itself_us_an_arm"]
    return int(args.check and any(found[name] > most for name, most in MOST_US.items()))


if __name__ == "__main__":
    sys.exit(main())
