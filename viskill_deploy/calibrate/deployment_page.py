"""Trials on hidden robots beside the paper's, as figures and as Markdown."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any

from viskill_deploy.calibrate.deployment import (
    CALIBRATED,
    EXACT,
    UNCALIBRATED,
    Deployment,
    Trial,
    by_robot,
    of_condition,
)

PAPER = (16, 20)
"""Successes and trials of the paper on its dVRK: BiPegTransfer, planned in simulation."""

Z95 = 1.959964
"""Half of the two-sided 95 % interval of a normal distribution, in standard deviations."""

OFF_MM = (0.0, 0.25, 0.5, 0.75, 1.0, math.inf)
TURNED_DEG = (0.0, 1.0, 2.0, 3.0, math.inf)
BESIDE_M = 0.001
"""Blocks that start within this of each other started at one place."""

INTRODUCTION = """# A policy on hidden robots, before and after calibration

**All of this is simulated.** The paper ran waypoints that were planned in simulation on one real
dVRK: {wins} of {trials} trials of BiPegTransfer were done. Here the same is tried on {robots}
simulated robots that are not as their files say ([calibration.md](calibration.md#hidden-robots)):
bases, joint zeros, shafts, cables, board, and where the block is seen, each drawn from a
seed{part}. Every trial goes through line and gate, stepped, at {rate} Hz.{calibration} A success
here says nothing about a real dVRK; it says what the errors above do to a policy, and what
calibration does about them.

Intervals are Wilson's, 95 %. Trials on one robot are more alike than trials on several, so
intervals over all robots are narrower than they should be; the spread between robots stands beside
them.

This page is built by `{command}`.
"""

KNOWN = """Arms that are known exactly are what a calibration without error would give: what such a
trial misses is owed to where the block is seen, and to the policy.
"""


def interval(wins: int, trials: int) -> tuple[float, float]:
    """95 % interval of a success rate. Source: Wilson 1927, without continuity correction."""
    if not trials:
        return 0.0, 1.0
    rate, z2 = wins / trials, Z95 * Z95
    centre = (rate + z2 / (2 * trials)) / (1 + z2 / trials)
    half = Z95 * math.sqrt(rate * (1 - rate) / trials + z2 / (4 * trials**2)) / (1 + z2 / trials)
    return max(centre - half, 0.0), min(centre + half, 1.0)


def figures(what: Deployment, trials: Sequence[Trial]) -> dict[str, Any]:
    """What the trials came to, ready for JSON."""
    paper = {"successes": PAPER[0], "trials": PAPER[1], "interval": interval(*PAPER)}
    conditions = {}
    tried = {trial.condition for trial in trials} | set(what.conditions)
    for condition in (c for c in (*UNCALIBRATED, *CALIBRATED, EXACT) if c in tried):
        mine = of_condition(trials, condition)
        rates = [_rate(part) for part in by_robot(mine)]
        stopped = sum(bool(trial.stopped_by or trial.refused) for trial in mine)
        wins = sum(trial.success for trial in mine)
        conditions[condition] = {
            "successes": wins,
            "trials": len(mine),
            "interval": interval(wins, len(mine)),
            "robots": len(rates),
            "worst_robot": min(rates, default=None),
            "best_robot": max(rates, default=None),
            "stopped": stopped,
        }
    return {"simulated": True, **what.title(), "paper_dvrk": paper, "conditions": conditions}


def page(what: Deployment, trials: Sequence[Trial], command: str) -> str:
    """The whole page as Markdown."""
    robots = len({trial.robot for trial in trials})
    is_calibrated = any(trial.condition in CALIBRATED for trial in trials)
    samples = f" Calibration knows what {what.samples} points\nan arm of a simulated tracker tell."
    found = figures(what, trials)
    parts = [
        INTRODUCTION.format(
            wins=PAPER[0],
            trials=PAPER[1],
            robots=robots,
            calibration=samples if is_calibrated else "",
            part="" if what.scale == 1.0 else f" and then taken times {what.scale:g}",
            rate=what.title()["rate_hz"],
            command=command,
        ),
        _main_table(found),
    ]
    if EXACT in found["conditions"]:
        parts.append(KNOWN)
    if is_calibrated:
        turned = _binned(
            trials,
            "seen turned",
            "deg",
            TURNED_DEG,
            lambda t: math.degrees(abs(t.seen_turned_rad)),
        )
        parts += [
            "## Calibrated, by how far off the block is seen\n",
            _binned(trials, "seen off", "mm", OFF_MM, lambda t: 1e3 * t.seen_off_m),
            "## Calibrated, by how much it seems turned\n",
            turned,
            "## Calibrated, by where it lay\n",
            _placed(trials),
        ]
    return "\n".join(parts)


def _main_table(found: dict[str, Any]) -> str:
    paper = found["paper_dvrk"]
    rows = [["the paper's dVRK, plan", "1", *_counted(paper), "-", "-"]]
    for name, part in found["conditions"].items():
        worst, best = part["worst_robot"], part["best_robot"]
        span = "-" if worst is None else f"{100 * worst:.0f} to {100 * best:.0f} %"
        rows.append(
            [f"simulated, {name}", str(part["robots"]), *_counted(part), span, str(part["stopped"])]
        )
    head = ["", "robots", "success", "rate", "95 % interval", "worst to best robot"]
    return table([*head, "stopped by the gate, refused, or given up by the policy's value"], rows)


def _counted(part: dict[str, Any]) -> list[str]:
    wins, trials = part["successes"], part["trials"]
    if not trials:
        return ["not run", "-", "-"]
    low, high = part["interval"]
    return [f"{wins} of {trials}", f"{100 * wins / trials:.0f} %", _percents(low, high)]


def _percents(low: float, high: float) -> str:
    return f"{100 * low:.0f} to {100 * high:.0f} %"


def _rate(trials: Sequence[Trial]) -> float:
    return sum(trial.success for trial in trials) / len(trials)


def _binned(
    trials: Sequence[Trial],
    what: str,
    unit: str,
    edges: Sequence[float],
    value: Callable[[Trial], float],
) -> str:
    """Success in each part of a range, of all that was calibrated."""
    rows = []
    for low, high in pairwise(edges):
        name = f"{low:g} to {high:g} {unit}" if math.isfinite(high) else f"from {low:g} {unit}"
        rows.append(_row(name, [t for t in trials if low <= value(t) < high]))
    return table([what, *CALIBRATED], rows)


def _placed(trials: Sequence[Trial]) -> str:
    """Success by the place where the block lay, to the millimetre."""
    places = sorted({_place(trial) for trial in trials})
    rows = [_row(f"({x}, {y}) mm", [t for t in trials if _place(t) == (x, y)]) for x, y in places]
    return table(["block at", *CALIBRATED], rows)


def _place(trial: Trial) -> tuple[int, int]:
    x, y = (round(value / BESIDE_M) for value in trial.start_m)
    return x, y


def _row(name: str, trials: Sequence[Trial]) -> list[str]:
    cells = []
    for condition in CALIBRATED:
        mine = of_condition(trials, condition)
        wins = sum(trial.success for trial in mine)
        cells.append(
            f"{wins} of {len(mine)} ({_percents(*interval(wins, len(mine)))})" if mine else "-"
        )
    return [name, *cells]


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table as Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
