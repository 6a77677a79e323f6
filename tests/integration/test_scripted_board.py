"""BiPegBoard through the whole line: IK, smoothing, gate and loopback, driven by the script."""

from pathlib import Path

import pytest
from scripted import scripted
from untrained import write_untrained

from viskill_deploy.runtime.dry_run import DryRunOptions, dry_run
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


@pytest.mark.no_cover
def test_in_a_plan_the_gate_never_steps_in_and_the_ring_ends_on_its_peg(tmp_path: Path) -> None:
    bundle = scripted(write_untrained(tmp_path / "untrained", TASK), TASK)
    prepared = Prepared(bundle, TASK, TASK.cell, (), ())
    outcome = dry_run(prepared, DryRunOptions(1, 0, "wide", "plan"), Blank())  # type: ignore[arg-type]
    assert outcome.failure is None, outcome.failure
    figures = outcome.figures
    assert figures["success_rate"] == 1.0
    assert figures["interventions"] == figures["refused"] == 0
    assert figures["worst_action"] == "PASS"
    assert min(figures["margins"].values()) >= 0.0
    assert figures["tip_speed_max_m_s"] <= TASK.cell.file.motion.tip_speed_m_s
