"""A cell with one arm through the whole line: MatchBoardPanel, driven by its script."""

from pathlib import Path

import numpy as np
import pytest
from scripted import scripted
from untrained import write_untrained

from viskill_deploy.runtime.dry_run import DryRunOptions, dry_run
from viskill_deploy.runtime.preflight import Prepared, prepare
from viskill_deploy.sim.tasks import load_task

TASK = load_task("matchboardpanel")


class Silence:
    """A recorder that keeps only what moved on the board."""

    alive = True

    def __init__(self) -> None:
        self.openings: list[list[float]] = []

    def cycle(self, *args: object) -> None:
        pass

    def scene(self, now: float, scene: object) -> None:
        doors = [scene.pose(f"door{row}")[1, 3] for row in range(3)]  # type: ignore[attr-defined]
        self.openings.append(doors)

    def mark(self, *args: object, **more: object) -> None:
        pass


@pytest.mark.invariant("S33")
@pytest.mark.no_cover
def test_a_plan_runs_through_ik_smoothing_and_gate_without_an_intervention(tmp_path: Path) -> None:
    bundle = scripted(write_untrained(tmp_path / "scripted", TASK), TASK)
    prepared = Prepared(bundle, TASK, TASK.cell, (), ())
    recorder = Silence()
    options = DryRunOptions(episodes=1, seed=3, distribution="wide", mode="plan")
    outcome = dry_run(prepared, options, recorder, lambda result: None)
    figures = outcome.figures
    assert outcome.failure is None
    assert figures["success_rate"] == 1.0
    assert figures["interventions"] == figures["refused"] == 0
    (episode,) = figures["episode_results"]
    assert [skill["success"] for skill in episode["skills"]] == [True] * 4
    # the wrist stays past the cannula by far, the tip under its speed, the joints off their limits
    assert figures["margins"]["S13"] > 0.3
    assert figures["tip_speed_max_m_s"] < 0.05
    assert figures["joint_margin_min"] > 0.1
    openings = np.array(recorder.openings)
    assert openings.max() == pytest.approx(0.075, abs=2e-3)
    assert openings[-1].max() < 0.005


def test_a_bundle_for_one_arm_passes_preflight(tmp_path: Path) -> None:
    prepared = prepare(write_untrained(tmp_path / "untrained", TASK))
    assert len(prepared.cell.arms) == 1
    assert prepared.task.name == "matchboardpanel"
