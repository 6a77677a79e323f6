"""What the gate says on fixed random walks, to be held against `tests/golden/gate_trace.txt`.

Bounds that are a little wider than they need to be are no danger and break no law; only here do
they show. A change on purpose is written down by `make numbers`.
"""

from __future__ import annotations

import math
import random
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.soak.run import Chunk, Walk
from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.types import Action, CellState, JointSetpoint, Request
from viskill_deploy.safety.decision import Decision
from viskill_deploy.safety.envelope import ArmEnvelope, CellEnvelope
from viskill_deploy.safety.reach import Reach
from viskill_deploy.safety.rules.s15_conditioning import changes
from viskill_deploy.safety.stopping import CommonStop, JointStop
from viskill_deploy.safety.track import ArmTrack

GOLDEN = Path(__file__).resolve().parents[1] / "golden/gate_trace.txt"
SEEDS, STEPS = range(6), 400
CELLS = (
    "bipegtransfer",
    "bipegboard",
    "matchboardpanel",
    "bodytrainer",
    "bipegtransfer, stricter",
    "bodytrainer, stricter",
)
PERIOD = 0.004
NUMBER = re.compile(r"-?\d+\.\d+(?:e[-+]\d+)?|-?\d+e[-+]\d+")


def number(value: float) -> str:
    """Nine digits, always with a point: what `same` takes for a number that may be rounded."""
    text = f"{value:.9g}"
    return text if not math.isfinite(value) or "." in text or "e" in text else f"{text}.0"


class _Notebook(Walk):
    """A walk that writes down what the gate says."""

    def begin(self) -> None:
        super().begin()
        check = self.rig.gate.check

        def noted(state: CellState, request: Request, now: float) -> Decision:
            decision = check(state, request, now)
            self.lines.append(self._line(decision))
            return decision

        self.rig.gate.check = noted  # type: ignore[method-assign]

    def __init__(self, seed: int) -> None:
        self.lines: list[str] = []
        super().__init__(Chunk(seed))

    def _line(self, d: Decision) -> str:
        said = [
            f"{v.rule} {v.action.name} {v.arm} {v.joint} {number(v.value)} {number(v.limit)}"
            for v in d.verdicts
        ]
        margins = [
            f"{rule}={number(margin)}"
            for rule, margin in zip(self.rig.gate.rules, d.margins, strict=True)
            if margin != 1.0
        ]
        flags = f"{d.action.name} {d.mode.name} {d.passed:d}{d.at_rest:d} {number(d.speed_scale)}"
        return f"{flags} | {'; '.join(said)} | {' '.join(margins)}"


def walk(seed: int) -> list[str]:
    """Lines of a walk: all with a verdict, and every tenth of the others."""
    notes = _Notebook(seed)
    notes.run(STEPS)
    return [
        f"{k} {line}"
        for k, line in enumerate(notes.lines)
        if k % 10 == 0 or not line.startswith(Action.PASS.name)
    ]


def _row(*values: Any) -> str:
    return " ".join(number(float(x)) for x in values)


def _sample(s: JointSetpoint) -> str:
    return _row(*s.jp, *s.jv, s.jaw, s.jaw_v)


def joint_stops() -> list[str]:
    """Stops of one joint from random motions and from borders between their cases."""
    rng, found = random.Random(0), []
    speeds, rates = (-1.5, -0.2, -1e-3, 0.0, 0.05, 1.2), (-7.85, -2.0, 0.0, 0.4, 7.85, 9.0)
    cases = [(v, a) for v in speeds for a in rates]
    cases += [(rng.uniform(-1.6, 1.6), rng.uniform(-8.0, 8.0)) for _ in range(20)]
    for v, a in cases:
        stop = JointStop(0.3, v, a, 7.85, 157.0)
        there = [x for part in (0.2, 0.5, 0.9) for x in stop.at(part * stop.duration_s)]
        found.append(_row(stop.duration_s, stop.end, *stop.extent(), *there))
    return found


def moving(arm: ArmEnvelope, rng: random.Random, part: float) -> ArmTrack:
    """An arm in the middle of its ranges, asked for a random step of a smooth motion."""
    track = ArmTrack(0, arm, PERIOD)
    middle = [0.5 * (low + high) for low, high in zip(arm.lower, arm.upper, strict=True)]
    middle = [x + 0.05 * rng.uniform(-1.0, 1.0) for x in middle]

    def setpoint(steps: list[float]) -> JointSetpoint:
        q = [x + s for x, s in zip(middle, steps, strict=True)]
        return JointSetpoint(tuple(q[:-1]), (0.0,) * (len(q) - 1), q[-1], 0.0)

    v = [part * rng.uniform(-1.0, 1.0) * x for x in arm.max_speed]
    a = [part * rng.uniform(-1.0, 1.0) * x for x in arm.max_acceleration]
    track.begin(setpoint([0.0] * len(v)))
    for k in (1, 2):
        t = k * PERIOD
        track.ask(setpoint([x * t + 0.5 * y * t * t for x, y in zip(v, a, strict=True)]))
        if k == 1:
            track.accept()
    return track


def stricter(cell: CellDescription) -> CellDescription:
    """A cell that stands askew, and whose joints have other limits, each in another proportion."""
    arms = []
    c, s = math.cos(0.3), math.sin(0.3)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ [[1, 0, 0], [0, c, -s], [0, s, c]]
    for cell_arm in cell.arms:
        joints = []
        for k, joint in enumerate(cell_arm.arm.joints):
            rates = [key for key in type(joint).model_fields if key.startswith("max_")]
            less = {
                key: getattr(joint, key) * (0.95 - 0.03 * k - 0.11 * n)
                for n, key in enumerate(rates)
            }
            joints.append(joint.model_copy(update=less))
        base = np.array(cell_arm.T_task_base)
        base[:3, :3] = turn @ base[:3, :3]
        arm = replace(cell_arm.arm, joints=tuple(joints))
        arms.append(replace(cell_arm, arm=arm, T_task_base=base))
    return replace(cell, arms=tuple(arms))


def arms(name: str) -> list[str]:
    """Stops, reaches, points and Jacobians of a cell's arms."""
    rng, found = random.Random(1), list[str]()
    cell = load_cell(name.removesuffix(", stricter"))
    cell = stricter(cell) if name.endswith("stricter") else cell
    for arm in CellEnvelope.of(cell, PERIOD).arms:
        for part in (0.02, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0):
            track = moving(arm, rng, part)
            for reach in (Reach(arm, PERIOD), Reach(arm, PERIOD, True)):
                time = reach.speed_and_time(track.fastest, track.sharpest)
                found.append(_row(*time, reach.travel(track)))
            if arm.levers:
                found.append(_row(*changes(arm)))
            stop = track.stop()
            extents = [x for joint in (0, 1, 2, 5) for x in track.asked_extent(joint)]
            found.append(_row(stop.duration_s, *extents, *track.asked_end()))
            found += [_sample(stop.at(t)) for t in (0.02, 0.1)]
            found.append(_row(*(x for point in track.asked_points for x in point)))
            columns = arm.chain.jacobian(track.asked_q)
            found.append(_row(*(x for column in columns for x in column)))
            found.append(_row(*(x for row in arm.chain.tip_pose(track.asked_q) for x in row)))
    return found


def common_stops() -> list[str]:
    """Stops of an arm under one clock, from straight and bent motions, fast ones and hardly any."""
    (arm,) = CellEnvelope.of(load_cell("bodytrainer"), PERIOD).arms
    rng, found = random.Random(2), []
    for part in (0.0, 1e-6, 0.01, 0.1, 0.3, 0.6, 1.0):
        for bend in (0.0, 0.05, 0.5, 1.0):
            motions = [
                (0.1, part * rng.uniform(-1.0, 1.0) * v, bend * rng.uniform(-1.0, 1.0) * a)
                for v, a in zip(arm.max_speed, arm.max_acceleration, strict=True)
            ]
            stop = CommonStop(motions, arm.max_acceleration, arm.max_jerk)
            extents = [x for joint in range(7) for x in stop.extent(joint)]
            found.append(_row(stop.duration_s, *stop.end, *extents))
            found += [_sample(stop.at(t)) for t in (0.01, 0.03, 0.1, 0.5)]
    for _ in range(300):
        part, bend = rng.random(), rng.choice([0.05, 0.2, 0.5, 1.0])
        motions = [
            (0.0, part * rng.uniform(-1.0, 1.0) * v, bend * rng.uniform(-1.0, 1.0) * a)
            for v, a in zip(arm.max_speed, arm.max_acceleration, strict=True)
        ]
        stop = CommonStop(motions, arm.max_acceleration, arm.max_jerk)
        found.append(_row(stop.duration_s, stop.end[0], stop.at(0.02).jv[3]))
    return found


def collect() -> dict[str, list[str]]:
    """All of it, by title."""
    return {
        **{f"walk {seed}": walk(seed) for seed in SEEDS},
        **{f"arms of {cell}": arms(cell) for cell in CELLS},
        "stops of a joint": joint_stops(),
        "common stops": common_stops(),
    }


def golden() -> dict[str, list[str]]:
    """What was agreed on."""
    found: dict[str, list[str]] = {}
    for line in GOLDEN.read_text(encoding="utf-8").splitlines():
        if line.startswith("# "):
            lines = found[line[2:]] = []
        else:
            lines.append(line)
    return found


def same(ours: str, agreed: str) -> bool:
    """Whether two lines say the same, but for the last digits of numbers."""
    if ours == agreed:
        return True
    one, other = (list(map(float, NUMBER.findall(line))) for line in (ours, agreed))
    words = NUMBER.sub("#", ours) == NUMBER.sub("#", agreed)
    return words and all(
        math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-9) for a, b in zip(one, other, strict=True)
    )


def write() -> None:
    """Writes the golden file anew."""
    parts = [f"# {title}\n" + "\n".join(lines) for title, lines in collect().items()]
    GOLDEN.write_text("\n".join(parts) + "\n", encoding="utf-8")
