"""Nominal dry-runs on a cell with ordinary imperfections: does the gate ever step in?

    python benchmarks/no_false_trips.py --runs 1000 --output build/no_false_trips.jsonl

Every run draws another layout for the next of the shipped bundles, with measurement noise, a
control loop that wakes up to 3 ms late, and one message in a hundred lost each way. A line of JSON
a run goes to the output file; started again, the program goes on after the last of them. Ctrl-C and
SIGTERM end it after the run under way was brought to rest; that run is done again next time.

Exits with 1 when the gate stepped in or refused a run.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

from viskill_deploy.core.errors import Interrupted
from viskill_deploy.observe.labels import rule_label
from viskill_deploy.runtime.dry_run import DryRunOptions, dry_run
from viskill_deploy.runtime.preflight import Prepared, prepare
from viskill_deploy.runtime.record import NoRecord
from viskill_deploy.sim.world import WorldOptions

POLICIES = Path(__file__).parents[1] / "policies"
BUNDLES = ("bipegtransfer-viskill", "matchboardpanel-viskill", "bipegboard-viskill")

NOISE = WorldOptions(
    joint_noise_rad=2e-4,
    joint_noise_m=2e-5,
    object_noise_m=2e-4,
    drop_rate=0.01,
    jitter_s=0.003,
)
"""Four times the resolution of a Classic's yaw encoder, 20 um of insertion, 0.2 mm of a tracker."""


def one_run(prepared: Prepared, number: int, mode: str) -> dict[str, Any]:
    """What came of one run.

    Raises:
        Interrupted: somebody ended it.
    """
    began = time.process_time()
    options = DryRunOptions(seed=number, world=NOISE, mode=mode)
    outcome = dry_run(prepared, options, NoRecord())
    if isinstance(outcome.failure, Interrupted):
        raise outcome.failure
    figures = outcome.figures
    (episode,) = figures["episode_results"] or ({},)
    return {
        "run": number,
        "bundle": figures["bundle"],
        "mode": mode,
        "success": bool(episode.get("success")),
        "stopped_by": episode.get("stopped_by", ""),
        "refused": episode.get("refused", "") or str(outcome.failure or ""),
        "reason": episode.get("reason", ""),
        "worst_action": figures["worst_action"],
        "margins": figures["margins"],
        "simulated_s": figures["simulated_s"],
        "cpu_s": time.process_time() - began,
    }


def done_before(path: Path) -> list[dict[str, Any]]:
    """The runs that the file holds; a line that was cut off is dropped from it."""
    if not path.exists():
        return []
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    whole = [line for line in lines if line.endswith("\n")]
    if len(whole) < len(lines):
        path.write_text("".join(whole), encoding="utf-8")
    return [json.loads(line) for line in whole]


def summary(rows: list[dict[str, Any]]) -> int:
    """Prints what all runs came to; returns the exit code."""
    if not rows:
        print("no run is done yet")
        return 1
    stopped = [row for row in rows if row["stopped_by"]]
    refused = [row for row in rows if row["refused"]]
    for row in stopped:
        print(
            f"run {row['run']} ({row['bundle']}): {rule_label(row['stopped_by'])} {row['reason']}"
        )
    for row in refused:
        print(f"run {row['run']} ({row['bundle']}): refused, {row['refused']}")
    simulated = sum(row["simulated_s"] for row in rows) / 3600.0
    cpu = sum(row["cpu_s"] for row in rows) / 60.0
    print(f"runs: {len(rows)}, {simulated:.2f} h simulated, {cpu:.1f} min of one core")
    print(f"successes: {sum(row['success'] for row in rows)}")
    print(f"interventions: {len(stopped)}, refused: {len(refused)}")
    least = {
        rule: min(row["margins"].get(rule, 1.0) for row in rows) for rule in rows[-1]["margins"]
    }
    for rule, margin in sorted(least.items(), key=lambda item: item[1]):
        if margin < 0.5:
            print(f"smallest margin to {rule_label(rule)}: {100.0 * margin:.1f} %")
    return 1 if stopped or refused else 0


def main() -> int:
    """Runs what is missing; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--mode", choices=("closed-loop", "plan"), default="closed-loop")
    parser.add_argument("--output", type=Path, default=Path("build/no_false_trips.jsonl"))
    parser.add_argument(
        "--share", default="1/1", help="2/3: the second of three programs with files of their own"
    )
    args = parser.parse_args()
    part, parts = map(int, args.share.split("/"))
    args.output.parent.mkdir(parents=True, exist_ok=True)
    rows = done_before(args.output)
    known = {row["run"] for row in rows}
    jobs = [prepare(POLICIES / name) for name in BUNDLES]
    with args.output.open("a", encoding="utf-8") as file:
        for number in range(args.runs):
            if number in known or number % parts != part % parts:
                continue
            try:
                row = one_run(jobs[number % len(jobs)], number, args.mode)
            except (Interrupted, KeyboardInterrupt):
                print(f"interrupted before run {number}; start again to go on", file=sys.stderr)
                summary(rows)
                return Interrupted.exit_code
            rows.append(row)
            file.write(json.dumps(row) + "\n")
            file.flush()
    return summary(rows)


if __name__ == "__main__":
    sys.exit(main())
