"""BiPegBoard through the whole line: IK, smoothing, gate and loopback, driven by the script."""

from pathlib import Path
from typing import Any

import pytest
from scripted import scripted
from untrained import write_untrained

from viskill_deploy.runtime.dry_run import DryRunOptions, Mode, dry_run
from viskill_deploy.runtime.preflight import Prepared
from viskill_deploy.sim.tasks import load_task

TASK = load_task("bipegboard")


class Blank:
    """A recorder that keeps nothing."""

    alive = True

    def cycle(self, *args: object) -> None:
        pass

    def scene(self, *args: object) -> None:
        pass

    def mark(self, *args: object, **more: object) -> None:
        pass


def run(
    folder: Path, distribution: str, mode: Mode, episodes: int, seed: int = 0
) -> dict[str, Any]:
    bundle = scripted(write_untrained(folder / "untrained", TASK), TASK)
    prepared = Prepared(bundle, TASK, TASK.cell, (), ())
    options = DryRunOptions(episodes, seed, distribution, mode)
    outcome = dry_run(prepared, options, Blank())  # type: ignore[arg-type]
    assert outcome.failure is None, outcome.failure
    return outcome.figures


@pytest.mark.parametrize("mode", ["closed-loop", "plan"])
@pytest.mark.parametrize("distribution", ["reference", "wide"])
def test_the_gate_never_steps_in_and_every_ring_ends_on_its_peg(
    distribution: str, mode: Mode, tmp_path: Path
) -> None:
    figures = run(tmp_path, distribution, mode, episodes=1)
    assert figures["success_rate"] == 1.0
    assert figures["interventions"] == figures["refused"] == 0
    assert figures["worst_action"] == "PASS"
    assert min(figures["margins"].values()) >= 0.0
    assert figures["tip_speed_max_m_s"] <= TASK.cell.file.motion.tip_speed_m_s
