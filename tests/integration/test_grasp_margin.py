"""A jaw goes down between a block's wall and its peg; there is room for a millimetre of error."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from silent_recorder import SilentRecorder

from viskill_deploy.core.types import Scene
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.runtime.boundaries import Job
from viskill_deploy.runtime.episodes import from_start_pose
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.preflight import prepare
from viskill_deploy.runtime.session import Session
from viskill_deploy.sim.tasks.bipegtransfer import BiPegTransfer
from viskill_deploy.sim.world import WorldOptions

PREPARED = prepare(Path("policies/bipegtransfer-viskill"))
NEARER_M = 0.0009


def _nearer_to_its_peg(task: BiPegTransfer, scene: Scene) -> Scene:
    """The block stands so that the wall that PSM2 takes is nearer to the peg."""
    T = scene.pose(scene.active).copy()
    out = T[:2, :2] @ np.array(task.block.grasp_frame_xy_m[1])
    T[:2, 3] -= NEARER_M * out / np.linalg.norm(out)
    things = [
        replace(thing, T_task_object=T) if thing.name == scene.active else thing
        for thing in scene.objects
    ]
    return replace(scene, objects=tuple(things))


@pytest.mark.parametrize("seed", range(4))
def test_a_wall_that_is_nearly_a_millimetre_nearer_to_the_peg_is_still_taken(seed: int) -> None:
    task, cell = PREPARED.task, PREPARED.cell
    assert isinstance(task, BiPegTransfer)
    rng = np.random.default_rng(seed)
    layout = _nearer_to_its_peg(task, task.sample_layout(rng, "reference"))
    job = Job(PREPARED.bundle, task, 0)
    with closing(LoopbackDriver(cell, WorldOptions(0.01), seed)) as driver:
        driver.connect()
        driver.reset(layout)
        line, seen = Line(cell, driver.period_s), PREPARED.bundle.manifest.training_range.seen
        with Session(cell, driver, line, SilentRecorder(), seen) as session:
            result = from_start_pose(session, "closed-loop", job, rng, 0)
    assert result.success, result.stopped_by
