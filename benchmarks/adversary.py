"""An optimiser in the place of the policy: can any actions get something past the gate?

    python benchmarks/adversary.py --minutes 30 --output build/adversary.jsonl

In every round an evolution strategy looks for policy actions that bring one of the gate's margins
as low as it will go among the cycles that pass, on one of the three cells, through the whole line
in the stepped loopback. What went out is then held against limits and kinematics that share no code
with the gate (`tests/support/gate_oracle.py`), and what the simulated arms did against their hard
limits. A breach is anything beyond. A line of JSON a round goes to FILE; minutes that are there
already count, so the command can be stopped and started. Exits with 1 when there is a breach.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests/support"))

from gate_oracle import Oracle, Trail

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import SafetyStop, ViskillError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.motion.resolve import waypoint_at
from viskill_deploy.motion.waypoints import ActionSpec, apply_action
from viskill_deploy.observe.labels import rule_label
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.moves import axes_of, run_motion
from viskill_deploy.runtime.session import Session
from viskill_deploy.safety.decision import Decision
from viskill_deploy.sim.tasks.base import load_task

TASKS = ("bipegtransfer", "bipegboard", "matchboardpanel")
TARGETS = ("S03", "S05", "S06", "S07", "S10", "S11", "S12", "S13", "S14", "S15", "S17", "S30")
"""Rules whose margin the actions of a policy can move."""

STEPS, POPULATION, GENERATIONS = 10, 6, 6
"""Policy steps of one try, tries of a generation, generations of a round."""


@dataclass
class Witness:
    """A recorder that keeps what was sent; the gate's margins are read off on the way.

    Attributes:
        margins: smallest margin of each rule among the cycles that passed.
        beyond: how far any measured joint was beyond its `limits`, rad or m.
    """

    arms: int
    alive: bool = True
    process_id: int = 0
    trails: list[Trail] = field(default_factory=list)
    margins: dict[str, float] = field(default_factory=dict)
    beyond: float = 0.0
    limits: list[tuple[FloatArray, FloatArray]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.trails = [Trail() for _ in range(self.arms)]

    def watch(self, session: Session) -> None:
        """Stands between session and gate, and changes nothing."""
        check: Callable[..., Decision] = session.gate.check
        rules = session.gate.rules

        def witnessed(*args: Any) -> Decision:
            decision = check(*args)
            if decision.passed:
                for rule, margin in zip(rules, decision.margins, strict=True):
                    self.margins[rule] = min(self.margins.get(rule, 1.0), margin)
            for trail, checked in zip(self.trails, decision.setpoints, strict=False):
                trail.add(checked.setpoint, decision.passed)
            return decision

        session.gate.check = witnessed  # type: ignore[method-assign]

    def cycle(self, now: float, state: Any, *rest: Any) -> None:
        """How far a measured joint is beyond its limits is all that is kept."""
        del now, rest
        for arm, limits in zip(state.arms, self.limits, strict=True):
            q = np.array(arm.measured_jp)
            self.beyond = max(self.beyond, float(np.maximum(limits[0] - q, q - limits[1]).max()))

    def scene(self, *args: Any) -> None:
        """Nothing."""

    def mark(self, *args: Any, **more: Any) -> None:
        """Nothing."""


@cache
def place(name: str) -> tuple[Any, Any, LoopbackDriver]:
    """Task, cell and a connected loopback, once a process."""
    cell = load_cell(name)
    driver = LoopbackDriver(cell)
    driver.connect()
    return load_task(name), cell, driver


def attempt(name: str, actions: FloatArray, seed: int) -> tuple[Witness, list[str], str]:
    """One episode with given actions: what was seen, what got out, and who stopped it."""
    task, cell, driver = place(name)
    driver.reset(task.sample_layout(np.random.default_rng(seed), task.distributions[0]))
    witness = Witness(len(cell.arms))
    witness.limits = [(np.array(a.arm.limit(0)), np.array(a.arm.limit(1))) for a in cell.arms]
    session = Session(cell, driver, Line(cell, driver.period_s), witness)
    witness.watch(session)
    waypoint = waypoint_at(cell, axes_of(session.make_ready()))
    session.begin()
    spec = ActionSpec(rotation=task.action.rotation, pitch_rad=task.action.pitch_rad)
    free = (True,) * len(cell.arms)
    try:
        for action in actions:
            tips = session.line.links.tips(axes_of(session.read())[:, :6])
            waypoint = apply_action(waypoint, action, tips, cell, spec, "", free)
            session.go_to(waypoint)
            if not run_motion(session):
                break
    except ViskillError as error:
        session.line.fail(str(error))
    cause = session.cause
    session.settle()
    oracle = Oracle(cell, driver.period_s)
    found = [e for i, trail in enumerate(witness.trails) for e in oracle.escapes(i, trail)]
    if witness.beyond > 0.0:
        found.append(f"an arm stood {witness.beyond:.6f} rad or m beyond its limits")
    return witness, found, cause


def search(name: str, target: str, seed: int) -> dict[str, Any]:
    """One round: a (mu/mu, lambda) evolution strategy with its own step size for each number.

    Each parent generation is the better half; the spread of what was good is the next spread.
    """
    rng = np.random.default_rng(seed)
    size = (STEPS, 5 * len(load_cell(name).arms))
    mean, spread = rng.uniform(-1.0, 1.0, size), np.full(size, 0.6)
    margins: dict[str, float] = {}
    breaches: list[str] = []
    stops: dict[str, int] = {}
    began, tries = time.monotonic(), 0
    for _ in range(GENERATIONS):
        rows = [
            np.clip(mean + spread * rng.standard_normal(size), -1, 1) for _ in range(POPULATION)
        ]
        scores = []
        for row in rows:
            witness, found, cause = attempt(name, row, seed)
            tries += 1
            breaches += [f"{name}, seed {seed}: {text}" for text in found]
            stops[cause] = stops.get(cause, 0) + 1
            scores.append(witness.margins.get(target, 1.0))
            for rule, margin in witness.margins.items():
                margins[rule] = min(margins.get(rule, 1.0), margin)
        best = [rows[i] for i in np.argsort(scores)[: POPULATION // 2]]
        mean = np.mean(best, axis=0)
        spread = np.clip(0.7 * spread + 0.3 * np.std(best, axis=0), 0.05, 1.0)
    return {
        "seed": seed,
        "cell": name,
        "target": target,
        "tries": tries,
        "minutes": (time.monotonic() - began) / 60.0,
        "margins": margins,
        "stops": stops,
        "breaches": breaches,
    }


def read(path: Path) -> list[dict[str, Any]]:
    """Earlier rounds."""
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def report(rows: list[dict[str, Any]]) -> int:
    """Prints the worst margins; the exit code."""
    minutes, tries = sum(r["minutes"] for r in rows), sum(r["tries"] for r in rows)
    print(f"{tries} tries in {minutes:.1f} minutes, {len(rows)} rounds")
    lowest: dict[str, float] = {}
    for row in rows:
        for rule, margin in row["margins"].items():
            lowest[rule] = min(lowest.get(rule, 1.0), margin)
    stops: dict[str, int] = {}
    for row in rows:
        for rule, count in row["stops"].items():
            stops[rule] = stops.get(rule, 0) + count
    print("| rule | lowest margin that passed | tries that it stopped |\n|---|---|---|")
    for rule in sorted(lowest):
        print(f"| {rule_label(rule)} | {lowest[rule]:.3f} | {stops.get(rule, 0)} |")
    breaches = [text for row in rows for text in row["breaches"]]
    print(f"{len(breaches)} breaches; {stops.get('', 0)} tries were not stopped")
    for text in breaches[:20]:
        print(f"  {text}")
    return 1 if breaches else 0


def main() -> int:
    """Runs the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--output", type=Path, default=Path("build/adversary.jsonl"))
    options = parser.parse_args()
    options.output.parent.mkdir(parents=True, exist_ok=True)
    rows = read(options.output)
    while sum(row["minutes"] for row in rows) < options.minutes:
        seed = len(rows)
        try:
            row = search(TASKS[seed % len(TASKS)], TARGETS[seed // len(TASKS) % len(TARGETS)], seed)
        except SafetyStop as error:
            print(f"seed {seed}: the gate does not arm: {error}")
            return 2
        rows.append(row)
        with options.output.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
    return report(rows)


if __name__ == "__main__":
    sys.exit(main())
