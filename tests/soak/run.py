"""Drives the gate through millions of random cycles: `make soak`.

Every cycle is a random state, a random request and a random time; motions that are good, that are
a little over a limit, and nonsense take turns, and people resume, reset and arm again. In each
cycle what goes out has to be the request itself, or the gate's own stop; `gate_oracle` then holds
all of it against limits and kinematics that share no code with the gate.

Resumable: every chunk is a line of `build/soak/results.jsonl` and is one seed, so that any chunk
can be run again alone (`--only SEED`). Chunks count as long as gate and thresholds are the same
bytes. Exit codes: 0 no escape, 1 an escape, 2 not all steps were done.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import multiprocessing
import os
import random
import sys
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests/support")]

from gate_oracle import Oracle, Trail  # noqa: E402
from gate_rig import Rig  # noqa: E402

from viskill_deploy.core.description import load_cell  # noqa: E402
from viskill_deploy.core.types import Action, JointSetpoint, Mode  # noqa: E402

RESULTS = ROOT / "build/soak/results.jsonl"
CHUNK = 20_000
CELLS = [load_cell(name) for name in ("bipegtransfer", "bipegboard", "matchboardpanel")]
PERIODS = (0.004, 0.004, 0.002, 0.001, 0.01)
NONSENSE: list[Any] = [
    math.nan, math.inf, -math.inf, 1e308, -1e9, 5e-324, None, "0.1", 1, True, [0.0], (0.0,) * 7,
]  # fmt: skip
BROKEN: dict[str, list[Any]] = {
    "measured_jp": [(math.nan,) * 6, (2.0,) * 6, (0.0,) * 5, None],
    "setpoint_jp": [(0.1,) * 6, (math.inf,) * 6],
    "stamp_s": [0.0, math.nan, 1e12],
    "valid": [False],
    "is_homed": [False],
    "operating_state": ["FAULT", "", None],
    "tool": ["another"],
    "jaw_measured_jp": [math.nan],
}


@dataclass
class Chunk:
    """One seed's walk.

    Attributes:
        steps: cycles in which the gate was in charge.
        counts: of what the gate did.
        escapes: what must not be.
    """

    seed: int
    steps: int = 0
    counts: Counter[str] = field(default_factory=Counter)
    escapes: list[str] = field(default_factory=list)
    worst: dict[str, float] = field(default_factory=dict)


class Walk:
    """A rig that is led about at random.

    Args:
        chunk: where the outcome goes.
    """

    def __init__(self, chunk: Chunk) -> None:
        self.chunk, self.rng = chunk, random.Random(chunk.seed)
        self.cell, self.period = self.rng.choice(CELLS), self.rng.choice(PERIODS)
        self.oracle = Oracle(self.cell, self.period)
        self.begin()

    def begin(self) -> None:
        """A new gate and a new operator."""
        self.rig = Rig(self.period, self.cell)
        self.arms = len(self.cell.arms)
        self.rig.now = self.rng.uniform(0.0, 1e4)
        self.trails = [Trail() for _ in range(self.arms)]
        self.speed = [[0.0] * 7 for _ in range(self.arms)]
        self.bend = [[0.0] * 7 for _ in range(self.arms)]
        if self.rig.arm():
            raise RuntimeError(f"seed {self.chunk.seed}: a sound cell does not arm")

    def run(self, steps: int) -> None:
        """Goes on until so many steps are done."""
        while self.chunk.steps < steps:
            mood = self.rng.choices(
                ["good", "over", "noise", "nonsense", "leap", "nothing", "trouble"],
                [60, 15, 10, 2, 3, 1, 2],
            )[0]
            self.act(mood, self.rng.randint(1, 5 if mood in ("leap", "nonsense") else 80))
            if self.rig.gate.mode is not Mode.RUNNING:
                self.recover()
        self.judge()

    def act(self, mood: str, cycles: int) -> None:
        """Some cycles in one mood."""
        rng, top = self.rng, 1.0
        if mood in ("good", "over"):
            share = (
                rng.choice([0.002, 0.01, 0.03, 0.1, 0.5])
                if mood == "good"
                else rng.uniform(0.05, 1.3)
            )
            self.wish = [[rng.uniform(-share, share) for _ in range(7)] for _ in self.speed]
            top = 0.9 if mood == "good" else rng.uniform(0.9, 1.5)
        if mood == "trouble":
            self.get_into_trouble()
        for _ in range(cycles):
            self.cycle(self.asked(mood, top), mood)
            if self.rig.gate.mode is not Mode.RUNNING and rng.random() < 0.2:
                break
        self.rig.broken, self.rig.said, self.rig.watchdog_s = {}, {}, None

    def get_into_trouble(self) -> None:
        """Something breaks that is not the request."""
        rng, rig = self.rng, self.rig
        kind = rng.randrange(6)
        if kind <= 2:
            name = rng.choice(sorted(BROKEN))
            rig.broken = {rng.randrange(self.arms): {name: rng.choice(BROKEN[name])}}
        elif kind == 3:
            rig.gate.report_fault(rng.choice(["S24", "S32", "?"]), rig.now)
        elif kind == 4:
            rig.said = {"consent": rng.choice([False, None, 1])}
        else:
            rig.watchdog_s = rig.now

    def asked(self, mood: str, top: float) -> tuple[JointSetpoint, ...] | None:
        """The next request's setpoints."""
        rng, rig = self.rng, self.rig
        if mood == "nothing":
            return None
        if mood in ("good", "over"):
            return tuple(self.smooth(arm, top) for arm in range(self.arms))
        setpoints = list(rig.going_on())
        if mood == "noise":
            size = 10.0 ** rng.uniform(-9, -2)
            return tuple(self.shaken(s, size) for s in setpoints)
        if mood == "leap":
            arm = rng.randrange(self.arms)
            setpoints[arm] = self.shaken(setpoints[arm], 10.0 ** rng.uniform(-3, 3))
        if mood == "nonsense":
            arm = rng.randrange(self.arms)
            setpoints[arm] = self.nonsense(setpoints[arm])
        return tuple(setpoints)

    def smooth(self, arm: int, top: float) -> JointSetpoint:
        """The next sample of a motion towards the wished speeds, its rates up to `top`."""
        held, before = self.rig.held[arm], self.rig.before[arm]
        limits, dt = self.rig.gate.envelope.arms[arm], self.period
        q, old = (*held.jp, held.jaw), (*before.jp, before.jaw)
        new, speeds = [], []
        for j in range(7):
            v = (q[j] - old[j]) / dt
            a = (v - self.speed[arm][j]) / dt
            most, turn = top * limits.max_acceleration[j], top * limits.max_jerk[j] * dt
            away = self.wish[arm][j] * limits.max_speed[j] - v
            goal = math.copysign(min(most, math.sqrt(abs(away) * turn / dt)), away)
            a += min(max(goal - a, -turn), turn)
            self.speed[arm][j] = v
            new.append(q[j] + (v + a * dt) * dt)
            speeds.append(v + a * dt)
        return JointSetpoint(tuple(new[:6]), tuple(speeds[:6]), new[6], speeds[6])

    def shaken(self, s: JointSetpoint, size: float) -> JointSetpoint:
        """A setpoint with every joint a little, or a lot, elsewhere."""
        rng = self.rng
        jp = tuple(q + rng.uniform(-size, size) for q in s.jp)
        return JointSetpoint(jp, s.jv, s.jaw + rng.uniform(-size, size), s.jaw_v)

    def nonsense(self, s: JointSetpoint) -> Any:
        """A setpoint that is none."""
        rng = self.rng
        value = rng.choice(NONSENSE)
        name = rng.choice(["jp", "jv", "jaw", "jaw_v", "all"])
        if name == "all":
            return value
        if name in ("jp", "jv") and rng.random() < 0.7:
            index = rng.randrange(6)
            vector = getattr(s, name)
            value = tuple(value if i == index else x for i, x in enumerate(vector))
        return replace(s, **{name: value})

    def cycle(self, asked: Any, mood: str) -> None:
        """One cycle, and the first look at what came out of it."""
        rng, rig, chunk = self.rng, self.rig, self.chunk
        dt = None
        if rng.random() < 0.02:
            dt = rng.choice([0.0, self.period * rng.uniform(0.3, 1.9), 0.02, 0.5, -rng.random()])
        flags = [(), (False,) * self.arms, (True,) * self.arms, (False,) * self.arms]
        said = {
            "holding": rng.choice(flags),
            "may_open_jaw": rng.choice([*flags, (True,)]) if mood == "nonsense" else flags[2],
            "waypoint_due_s": rig.now + rng.choice([math.inf, 1.0, 0.0, -0.05]),
        }
        before = rig.now
        decision = rig.ask(asked, dt, **said)
        rig.now = max(rig.now, before)
        sent = [checked.setpoint for checked in decision.setpoints]
        if not sent:
            return
        chunk.steps += 1
        chunk.counts[decision.action.name] += 1
        is_request = asked is not None and all(a is b for a, b in zip(sent, asked, strict=False))
        if len(sent) != self.arms or decision.passed != (decision.action < Action.HOLD):
            self.complain(f"{decision.action.name} with passed={decision.passed}")
        if decision.passed and not (is_request and len(sent) == len(asked)):
            self.complain("what was passed is not the request")
        numbers = [x for s in sent for x in (*s.jp, *s.jv, s.jaw, s.jaw_v)]
        if not all(type(x) is float and math.isfinite(x) for x in numbers):
            self.complain(f"a number that is none went out: {sent}")
        for trail, setpoint in zip(self.trails, sent, strict=True):
            trail.add(setpoint, decision.passed)

    def recover(self) -> None:
        """The operator does something; what is done too early has to be refused by the gate."""
        rng, rig = self.rng, self.rig
        wanted = rng.choice([0, 5, 30, 80])
        for _ in range(wanted):
            self.cycle(rng.choice([None, rig.stay()]), "recover")
        if rig.gate.mode is Mode.ESTOPPED:
            self.judge()
            self.begin()
        elif rng.random() < 0.3 and rig.gate.mode is Mode.HOLDING:
            rig.gate.resume(rig.state(), rig.now)
        else:
            rig.gate.reset(rig.now)
            if rig.gate.mode in (Mode.CONNECTED, Mode.HOMED, Mode.READY):
                self.judge()
                if rig.arm():
                    self.begin()
                else:
                    rig.older = rig.before = rig.held
        if rng.random() < 0.01:
            self.judge()
            self.begin()

    def judge(self) -> None:
        """Holds what went out since the last look against the limits."""
        for arm, trail in enumerate(self.trails):
            if trail.rows:
                for escape in self.oracle.escapes(arm, trail):
                    self.complain(f"arm {arm}: {escape}")
        self.trails = [Trail() for _ in range(self.arms)]
        self.chunk.worst = dict(self.oracle.worst)

    def complain(self, text: str) -> None:
        self.chunk.escapes.append(f"seed {self.chunk.seed}, step {self.chunk.steps}: {text}")


def run_chunk(seed: int, steps: int = CHUNK) -> Chunk:
    """One seed."""
    chunk = Chunk(seed)
    Walk(chunk).run(steps)
    return chunk


def fingerprint() -> str:
    """One hash of the gate, the thresholds and this file."""
    digest = hashlib.sha256()
    folders = [ROOT / "viskill_deploy/safety", ROOT / "viskill_deploy/core", ROOT / "robots"]
    paths = [p for folder in folders for p in folder.rglob("*") if p.suffix in (".py", ".toml")]
    paths += [Path(__file__), ROOT / "tests/support/gate_rig.py"]
    for path in sorted([*paths, ROOT / "tests/support/gate_oracle.py"]):
        digest.update(f"{path.relative_to(ROOT)}\0".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def results(key: str) -> dict[int, dict[str, Any]]:
    """Chunks that are done; a line that was cut off is not one."""
    found = {}
    if RESULTS.exists():
        for line in RESULTS.read_text(encoding="utf-8").splitlines():
            try:
                row = json.loads(line)
            except json.JSONDecodeError:
                continue
            if row["key"] == key:
                found[row["seed"]] = row
    return found


def work(seed: int) -> dict[str, Any]:
    """One chunk as a line of the results."""
    began = time.process_time()
    chunk = run_chunk(seed)
    return {**vars(chunk), "cpu_s": round(time.process_time() - began, 2)}


def report(rows: list[dict[str, Any]], wanted: int) -> int:
    """Prints what came of it; the exit code."""
    steps = sum(row["steps"] for row in rows)
    counts: Counter[str] = Counter()
    worst: dict[str, float] = {}
    for row in rows:
        counts.update(row["counts"])
        for name, part in row["worst"].items():
            worst[name] = max(worst.get(name, 0.0), part)
    escapes = [escape for row in rows for escape in row["escapes"]]
    print(f"{steps:,} steps in {sum(row['cpu_s'] for row in rows) / 60.0:.1f} minutes of one core")
    print("  " + ", ".join(f"{name} {count:,}" for name, count in counts.most_common()))
    for name, part in sorted(worst.items()):
        print(f"  {name}: at most {part:.4f} of what is allowed")
    print(f"{len(escapes)} escapes")
    for escape in escapes[:20]:
        print(f"  {escape}")
    if escapes:
        return 1
    return 0 if steps >= wanted else 2


def main() -> int:
    """Runs the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=5_000_000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop after this long")
    parser.add_argument("--only", type=int, default=None, metavar="SEED", help="one chunk again")
    options = parser.parse_args()
    if options.only is not None:
        return report([work(options.only)], CHUNK)
    RESULTS.parent.mkdir(parents=True, exist_ok=True)
    key, deadline = fingerprint(), time.monotonic() + 60.0 * options.minutes
    done = results(key)
    seeds = [seed for seed in range(math.ceil(options.steps / CHUNK)) if seed not in done]
    with multiprocessing.Pool(options.workers) as pool, RESULTS.open("a", encoding="utf-8") as file:
        for row in pool.imap_unordered(work, seeds):
            file.write(json.dumps({"key": key, **row}) + "\n")
            file.flush()
            done[row["seed"]] = row
            if time.monotonic() > deadline:
                pool.terminate()
                break
    return report(list(done.values()), options.steps)


if __name__ == "__main__":
    sys.exit(main())
