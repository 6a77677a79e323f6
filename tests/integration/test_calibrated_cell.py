"""Arms that are not where their files say: calibrated, a policy does its task on them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibrations import exact_calibration
from measured_arm import TYPICAL
from silent_recorder import SilentRecorder

from viskill_deploy.core.arm_errors import ArmErrors
from viskill_deploy.core.cables import Cables
from viskill_deploy.core.calibration_files import calibrated
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.types import CellState
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.motion.resolve import task_poses
from viskill_deploy.motion.waypoints import start_waypoint
from viskill_deploy.runtime import episodes
from viskill_deploy.runtime.boundaries import Job
from viskill_deploy.runtime.dry_run import DryRunOptions, dry_run
from viskill_deploy.runtime.ledger import EpisodeResult
from viskill_deploy.runtime.preflight import Prepared, prepare
from viskill_deploy.runtime.session import Session
from viskill_deploy.sim.tasks.base import load_task
from viskill_deploy.sim.world import WorldOptions

OTHER = ArmErrors(
    base_rotation_rad=(-0.01, 0.02, -0.015),
    base_translation_m=(-0.005, 0.004, 0.006),
    joint_offset=(0.0, -0.01, 0.007, -0.02, 0.02, 0.0),
    cables=Cables((0.012, 0.01, 0.015), ((0.01, 0.0, 0.0), (0.0, -0.03, 0.02), (0.0, 0.01, 0.02))),
)
TRUTH = (TYPICAL, OTHER)
CELL = load_cell("bipegtransfer")


def _calibrated(prepared: Prepared) -> Prepared:
    file = exact_calibration(prepared.cell, TRUTH)
    cell = calibrated(prepared.cell, file, Path("calibration/bipegtransfer.json"))
    return replace(prepared, cell=cell, task=load_task(prepared.task.name, cell))


def test_the_loopback_stands_where_the_files_say_whatever_a_calibration_says() -> None:
    cell = calibrated(CELL, exact_calibration(CELL, TRUTH), Path("x.json"))
    assert cell.filed is CELL
    ours, filed = LoopbackDriver(cell).world.model, LoopbackDriver(CELL).world.model
    np.testing.assert_array_equal(ours.body_pos, filed.body_pos)


@pytest.mark.parametrize("mode", ["closed-loop", "plan"])
def test_an_episode_begins_where_a_policy_has_learned_to_begin(
    mode: episodes.Mode, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = tuple(replace(errors, cables=Cables()) for errors in TRUTH)
    prepared = prepare(Path("policies/bipegtransfer-viskill"))
    cell = calibrated(CELL, exact_calibration(CELL, truth), Path("x.json"))
    begun: list[CellState] = []

    def play(session: Session, job: Job, rng: np.random.Generator, episode: int) -> EpisodeResult:
        begun.append(session.driver.state())
        return EpisodeResult(episode, success=True)

    monkeypatch.setattr(episodes, "closed_loop" if mode == "closed-loop" else "planned", play)
    options = DryRunOptions(world=WorldOptions(0.01, truth=truth), mode=mode)
    outcome = dry_run(replace(prepared, cell=cell), options, SilentRecorder())
    assert outcome.figures["success_rate"] == 1.0
    assert outcome.figures["interventions"] == 0
    for index, wanted in enumerate(start_waypoint(cell).T_task_tip):
        q = np.array([begun[0].arms[index].measured_jp])
        np.testing.assert_allclose(task_poses(cell, index, q)[0], wanted, atol=2e-3)
        found_by_file = task_poses(CELL, index, q)[0, :3, 3] - wanted[:3, 3]
        assert np.linalg.norm(found_by_file) > 4e-3, "a calibration that changes nothing"


@pytest.mark.no_cover
def test_calibrated_the_task_is_done() -> None:
    world = WorldOptions(truth=TRUTH)
    prepared = _calibrated(prepare(Path("policies/bipegtransfer-viskill")))
    figures = dry_run(prepared, DryRunOptions(world=world), SilentRecorder()).figures
    assert figures["success_rate"] == 1.0
    assert figures["interventions"] == 0
