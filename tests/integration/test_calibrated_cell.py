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
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.runtime.dry_run import DryRunOptions, dry_run
from viskill_deploy.runtime.preflight import Prepared, prepare
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


@pytest.mark.no_cover
def test_calibrated_the_task_is_done() -> None:
    world = WorldOptions(truth=TRUTH)
    prepared = _calibrated(prepare(Path("policies/bipegtransfer-viskill")))
    figures = dry_run(prepared, DryRunOptions(world=world), SilentRecorder()).figures
    assert figures["success_rate"] == 1.0
    assert figures["interventions"] == 0
