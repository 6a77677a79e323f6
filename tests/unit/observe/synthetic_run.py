"""A cell's run made of numbers: smooth joints, one moving block, a rule that speaks twice."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.types import (
    PSM_JOINTS,
    Action,
    ArmState,
    CellState,
    FloatArray,
    Inputs,
    JointSetpoint,
    Mode,
    ObjectPose,
    Request,
    Scene,
    Verdict,
)
from viskill_deploy.observe.recording import Recorder

PERIOD_S = 0.004
SKILLS = ("reach", "lift", "handover")
CENTRE = (0.0, 0.1, 0.12, 0.4, -0.2, 0.1)


@dataclass(frozen=True)
class Cycle:
    """Everything that one call of `Recorder.cycle` takes."""

    now: float
    state: CellState
    request: Request
    sent: tuple[JointSetpoint, ...]
    action: Action
    verdicts: tuple[Verdict, ...]
    tip_poses: tuple[FloatArray, ...] | None


def joints(time_s: float, phase: float) -> tuple[float, ...]:
    """Joint positions on a smooth curve inside the limits."""
    wave = [np.sin(0.9 * time_s + phase + k) for k in range(6)]
    scale = (0.2, 0.15, 0.03, 0.8, 0.5, 0.5)
    return tuple(float(c + a * w) for c, a, w in zip(CENTRE, scale, wave, strict=True))


def tip_pose(time_s: float, phase: float) -> FloatArray:
    """A tip that draws a circle and turns about z, task frame."""
    angle = 0.9 * time_s + phase
    c, s = float(np.cos(angle)), float(np.sin(angle))
    T = np.eye(4)
    T[:2, :2] = [[c, -s], [s, c]]
    T[:3, 3] = 0.03 * c, 0.03 * s + 0.03 * np.cos(phase), 0.03 + 0.01 * s
    return T


def cycle(cell: CellDescription, index: int) -> Cycle:
    """The cycle `index` of the run."""
    now = 5.0 + index * PERIOD_S
    arms, sent = [], []
    for number, arm in enumerate(cell.arms):
        asked, phase = joints(now, number * 3.0), number * 3.0
        measured, jaw = joints(now - 0.01, phase), 0.4 + 0.3 * float(np.sin(now))
        velocity = tuple(0.1 * value for value in measured)
        sent.append(JointSetpoint(asked, velocity, jaw, 0.02))
        arms.append(
            ArmState(
                arm.name, now - 0.001, True, "ENABLED", True, False, measured, velocity,
                jaw, 0.01, asked, jaw, PSM_JOINTS, arm.arm.tool,
            )
        )  # fmt: skip
    spoke = index % 100 == 50
    verdicts = (Verdict("S05", Action.SCALE, 1, 2, 0.21, 0.2),) if spoke else ()
    return Cycle(
        now,
        CellState(tuple(arms), Inputs(True, now, "simulated", False)),
        Request(tuple(sent)) if index % 7 else Request(None, "no solution"),
        tuple(sent),
        Action.SCALE if spoke else Action.PASS,
        verdicts,
        tuple(tip_pose(now, number * 3.0) for number in range(len(cell.arms))),
    )


def feed(
    recorder: Recorder, cell: CellDescription, cycles: range, episode: int = 0, every: int = 100
) -> None:
    """Records `cycles` with their scene and a mark `every` so many cycles."""
    for index in cycles:
        c = cycle(cell, index)
        if (index - cycles.start) % every == 0:
            skill = SKILLS[(index - cycles.start) // every % 3]
            recorder.mark(c.now, episode, skill, (index - cycles.start) // every)
        recorder.cycle(
            c.now, c.state, c.request, c.sent, c.action, c.verdicts, Mode.RUNNING, c.tip_poses
        )
        block = ObjectPose("block0", tip_pose(c.now, 0.0))
        recorder.scene(c.now, Scene(c.now, (block,), "block0", np.array([0.01, 0.02, 0.0])))


def record(path: Path, episodes: int = 1, cycles: int = 200, every: int = 100) -> CellDescription:
    """Records a whole run into the bag `path`."""
    cell = load_cell("bipegtransfer")
    with Recorder(path, cell, PERIOD_S, patience_s=30.0) as recorder:
        for episode in range(episodes):
            feed(recorder, cell, range(episode * cycles, (episode + 1) * cycles), episode, every)
    return cell
