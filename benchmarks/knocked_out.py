"""Whether a thing that is knocked out of the jaw is noticed before the next skill moves on.

    python benchmarks/knocked_out.py policies/bipegtransfer-viskill --episodes 200 --output FILE

For every layout two runs, closed loop or plan (`--mode`): a clean one, in which nothing may be
noticed, and one in which the thing is knocked out of the jaw at a random moment between the grasp
and the moment at which the next arm has it (with one arm: at which the next skill begins). A line
of JSON a layout goes to FILE; lines that are there already are not run again, so the command can
be stopped and started. `--check` exits with 1 when a goal is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from viskill_deploy.core.types import Boundary, FloatArray, JointSetpoint, Scene
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.runtime.boundaries import Job
from viskill_deploy.runtime.episodes import from_start_pose
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.preflight import Prepared, prepare
from viskill_deploy.runtime.session import Session

SEEDS = 2**28
"""First number of the seeds of these layouts: neither training nor dry runs use it."""

LIFTED_M = 0.003
"""A thing that an arm touches and that is so far above its place is held."""

GOAL = 0.95


class KnockingDriver(LoopbackDriver):
    """The loopback; at a time of its clock the active thing is knocked away."""

    knock_at_s = np.inf
    way: FloatArray = np.zeros(3)

    def advance(self) -> None:
        """One period of physics, and the knock when its time has come."""
        super().advance()
        if self.clock.now() >= self.knock_at_s:
            self.knock_at_s = np.inf
            self.world.knock(self.way)


class Witness:
    """A recorder that sees the truth: when the thing is held, and what is decided about it.

    Attributes:
        held_s: first and last time at which one arm alone held the thing off its place.
        boundaries: time, decision, and which arms touched the lifted thing.
    """

    alive = True

    def __init__(self, driver: KnockingDriver, has_one_arm: bool) -> None:
        self._driver, self._has_one_arm = driver, has_one_arm
        self._rest_m = driver.world.active_object().T_task_object[2, 3]
        self.held_s: list[float] = []
        self.boundaries: list[tuple[float, Boundary, tuple[bool, ...]]] = []
        self._is_taken = False

    def _held(self) -> tuple[bool, ...]:
        thing = self._driver.world.active_object()
        is_up = thing.T_task_object[2, 3] - self._rest_m > LIFTED_M
        return tuple(touched and is_up for touched in thing.touched)

    def cycle(self, now: float, state: object, request: object, sent: Sequence[JointSetpoint],
              *rest: object) -> None:  # fmt: skip
        """Looks whether one arm, and the first one only, holds the thing."""
        touched = self._driver.world.active_object().touched
        self._is_taken |= bool(self.held_s) and sum(touched) > 1
        if any(self._held()) and not self._is_taken and len(self.held_s) < 2:
            self.held_s.append(now)
        elif any(self._held()) and not self._is_taken:
            self.held_s[1] = now

    def scene(self, *args: object) -> None:
        """Not needed."""

    def mark(self, now: float, *args: object, boundary: Boundary | None = None, **more: object
             ) -> None:  # fmt: skip
        """Keeps what was decided, with the truth of that moment."""
        if boundary is not None:
            self.boundaries.append((now, boundary, self._held()))
            self._is_taken |= self._has_one_arm and bool(self.held_s)


def run(
    prepared: Prepared, layout: Scene, seed: int, mode: str, retries: int,
    knock: tuple[float, FloatArray] | None = None,
) -> tuple[EpisodeResult, Witness]:  # fmt: skip
    """One episode on a layout; `knock` gives time after the start and way."""
    task, cell = prepared.task, prepared.cell
    driver = KnockingDriver(cell)
    driver.connect()
    driver.reset(layout)
    if knock is not None:
        driver.knock_at_s, driver.way = knock
    witness = Witness(driver, len(cell.arms) == 1)
    training = prepared.bundle.manifest.training_range.seen
    with Session(cell, driver, Line(cell, driver.period_s), witness, training) as session:
        job = Job(prepared.bundle, task, retries)
        result = from_start_pose(session, mode, job, np.random.default_rng(seed), 0)
        session.ledger.end_episode(result)
    return result, witness


def pair(prepared: Prepared, number: int, args: argparse.Namespace) -> dict[str, Any]:
    """The clean and the knocked run of one layout."""
    rng = np.random.default_rng([SEEDS, number])
    distribution = args.distribution or prepared.task.distributions[0]
    layout = prepared.task.sample_layout(rng, distribution)
    began = time.process_time()
    result, witness = run(prepared, layout, number, args.mode, args.retries)
    row: dict[str, Any] = {
        "number": number,
        "clean_success": result.success,
        "clean_stopped_by": result.stopped_by,
        "false_alarms": sum(_is_false(boundary, held) for _, boundary, held in witness.boundaries),
        "alarms": sum(bool(boundary.lost) for _, boundary, _ in witness.boundaries),
        "planned_anew": len(result.off_plan),
    }
    if len(witness.held_s) == 2:
        row |= knocked(prepared, layout, number, args, rng, witness)
    else:
        row["outcome"] = "never held"
    return row | {"cpu_s": round(time.process_time() - began, 2)}


def _is_false(boundary: Boundary, held: tuple[bool, ...]) -> bool:
    """Whether a jaw is said to have lost a thing that is held."""
    return bool(boundary.lost) and any(held)


def knocked(
    prepared: Prepared, layout: Scene, number: int, args: argparse.Namespace,
    rng: np.random.Generator, clean: Witness,
) -> dict[str, Any]:  # fmt: skip
    """The run in which the thing is knocked away, and what came of it."""
    when = rng.uniform(*clean.held_s)
    angle, far = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.015, 0.03)
    way = far * np.array([np.cos(angle), np.sin(angle), 0.0])
    result, witness = run(prepared, layout, number, args.mode, args.retries, (when, way))
    after = [entry for entry in witness.boundaries if entry[0] >= when]
    row = {
        "knocked_s": round(when, 3),
        "success": result.success,
        "stopped_by": result.stopped_by,
        "retries": result.retries,
        "reason": result.reason,
    }
    if not after:
        return row | {"outcome": "gate first" if result.stopped_by else "no boundary"}
    at, boundary, held = after[0]
    row["noticed_after_s"] = round(at - when, 3)
    if boundary.course != "go on":
        return row | {"outcome": "noticed"}
    return row | {"outcome": "held again" if any(held) else "missed"}


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The figures of all layouts."""
    outcomes = Counter(row["outcome"] for row in rows)
    lost = outcomes["noticed"] + outcomes["missed"] + outcomes["gate first"]
    stopped = outcomes["noticed"] + outcomes["gate first"]
    return {
        "layouts": len(rows),
        "clean_success": sum(row["clean_success"] for row in rows),
        "clean_interventions": sum(bool(row["clean_stopped_by"]) for row in rows),
        "alarms_in_clean_runs": sum(row["alarms"] for row in rows),
        "false_alarms": sum(row["false_alarms"] for row in rows),
        "planned_anew_in_clean_runs": sum(row.get("planned_anew", 0) for row in rows),
        "outcomes": dict(outcomes),
        "stopped_before_next_skill": f"{stopped} of {lost}",
        "noticed_of_those_at_a_boundary": (
            f"{outcomes['noticed']} of {outcomes['noticed'] + outcomes['missed']}"
        ),
        "tried_again": sum(row.get("retries", 0) for row in rows),
        "success_when_tried_again": sum(
            bool(row.get("retries")) and row["success"] for row in rows
        ),
        "cpu_s": round(sum(row["cpu_s"] for row in rows)),
        "kept": bool(rows)
        and stopped >= GOAL * lost
        and not any(row["false_alarms"] for row in rows),
    }


def main() -> int:
    """Runs what is missing and prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--mode", choices=["closed-loop", "plan"], default="closed-loop")
    parser.add_argument("--distribution", default="")
    parser.add_argument("--retries", type=int, default=0)
    parser.add_argument("--check", action="store_true")
    args = parser.parse_args()
    prepared = prepare(args.bundle)
    lines = args.output.read_text().splitlines() if args.output.exists() else []
    rows = {row["number"]: row for row in map(json.loads, lines)}
    with args.output.open("a", encoding="utf-8") as file:
        for number in range(args.episodes):
            if number not in rows:
                rows[number] = pair(prepared, number, args)
                file.write(json.dumps(rows[number]) + "\n")
                file.flush()
    figures = summary([rows[number] for number in range(args.episodes)])
    print(json.dumps(figures, indent=2))
    return int(args.check and not figures["kept"])


if __name__ == "__main__":
    sys.exit(main())
