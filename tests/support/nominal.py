"""Nominal runs through the whole line, and the margins that they keep."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scripted import scripted
from untrained import write_untrained

from viskill_deploy.bundle.format import load_bundle
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.types import CellState, JointSetpoint, Request
from viskill_deploy.runtime.dry_run import DryRunOptions, dry_run
from viskill_deploy.runtime.episodes import Mode
from viskill_deploy.runtime.preflight import Prepared
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.sim.tasks import load_task

POLICIES = Path(__file__).resolve().parents[2] / "policies"
PERIOD_S = 0.004
EVERY = 4
"""Pairs are measured at every fourth setpoint: two arms come 1.4 mm nearer meanwhile at most."""


class PairRecorder:
    """Keeps the smallest distance of every pair over its slow one, m."""

    alive = True

    def __init__(self, cell: CellDescription) -> None:
        self._envelope = CellEnvelope.of(cell, PERIOD_S)
        self._ports = tuple(arm.port for arm in self._envelope.arms)
        self.pairs: dict[str, float] = {}
        self._cycles = 0

    def cycle(
        self,
        now: float,
        state: CellState,
        request: Request,
        sent: Sequence[JointSetpoint],
        *more: object,
    ) -> None:
        self._cycles += 1
        if self._cycles % EVERY:
            return
        arms = self._envelope.arms
        points = [arm.chain.points(s.jp) for arm, s in zip(arms, sent, strict=True)]
        for apart in self._envelope.apart:
            free = apart.gap(self._ports, points) - apart.slow
            self.pairs[apart.pair] = min(self.pairs.get(apart.pair, free), free)

    def scene(self, *args: object) -> None:
        pass

    def mark(self, *args: object, **more: object) -> None:
        pass


def margins_of(
    task_name: str, driver: str, folder: Path, mode: Mode, distribution: str, episodes: int
) -> tuple[dict[str, Any], dict[str, float]]:
    """Figures of a run by the "script" or the trained "policy", and margins per pair."""
    task = load_task(task_name)
    bundle = (
        scripted(write_untrained(folder / "untrained", task), task)
        if driver == "script"
        else load_bundle(POLICIES / f"{task_name}-viskill")
    )
    recorder = PairRecorder(task.cell)
    options = DryRunOptions(episodes, 0, distribution, mode)
    outcome = dry_run(Prepared(bundle, task, task.cell, (), ()), options, recorder)  # type: ignore[arg-type]
    assert outcome.failure is None, outcome.failure
    return outcome.figures, recorder.pairs


def table(title: str, figures: dict[str, Any], pairs: dict[str, float]) -> str:
    """Both lists as text, the smallest first."""
    lines = [f"{title}: success {figures['success_rate']:.0%}"]
    rules = sorted(figures["margins"].items(), key=lambda item: item[1])
    lines += [f"  {rule} {100.0 * margin:5.1f} %" for rule, margin in rules]
    near = sorted(pairs.items(), key=lambda item: item[1])
    lines += [f"  S14 {pair:<12} {1e3 * free:6.2f} mm over slow" for pair, free in near]
    return "\n".join(lines)
