"""A pose means the same wherever it is written, and no two frames are mixed up."""

import math

import numpy as np
import pytest

from viskill_deploy.core.cell_files import CellFile
from viskill_deploy.core.description import load_cell, rpy_matrix
from viskill_deploy.core.errors import DataFileError
from viskill_deploy.kinematics.model import forward_batch
from viskill_deploy.motion.frames import CONTROL_POINTS, FRAMES, Label, from_task, to_task

CELL = load_cell("bipegtransfer")
OFFICIAL_JOINTS = [0.25053, -0.00778, 0.10681, -0.33878, -0.07755, -0.23859]
"""Of PSM1 at the official start pose, measured in SurRoL (five digits)."""


def pose(position: tuple[float, ...], rpy_deg: tuple[float, ...]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rpy_matrix(*np.radians(rpy_deg).tolist()), position
    return T


def test_the_official_start_pose_is_where_its_joints_lead() -> None:
    tip = to_task(CELL, 0, Label("surrol", "jaw-pivot"), pose((2.5, 0.25, 3.776), (-90, 0, 90)))
    crtk = from_task(CELL, 0, Label("crtk", "jaw-pivot"), tip)
    wished = forward_batch(CELL.arms[0].arm, np.array([OFFICIAL_JOINTS]))[0]
    assert crtk == pytest.approx(wished, abs=1e-4)
    world = from_task(CELL, 0, Label("world", "jaw-pivot"), tip)
    assert world == pytest.approx(pose((0.5, 0.05, 0.7552), (-90, 0, 90)), abs=1e-12)
    rcm = from_task(CELL, 0, Label("rcm", "jaw-pivot"), tip)
    assert rcm[:3, 3] == pytest.approx(crtk[:3, 3])
    assert rcm[:3, 1] == pytest.approx(crtk[:3, 2]), "EEF y is the tip's z"


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("point", CONTROL_POINTS)
@pytest.mark.parametrize("scale", [None, 3.0])
def test_there_and_back_is_the_same_pose(frame: str, point: str, scale: float | None) -> None:
    rng = np.random.default_rng(4)
    tips = np.tile(np.eye(4), (20, 1, 1))
    tips[:, :3, :3] = [rpy_matrix(*rng.uniform(-3, 3, 3)) for _ in tips]
    tips[:, :3, 3] = rng.uniform(-0.1, 0.1, (20, 3))
    label = Label(frame, point, scale)
    for arm in (0, 1):
        back = to_task(CELL, arm, label, from_task(CELL, arm, label, tips))
        assert np.abs(back - tips).max() < 1e-14


def test_the_jaw_end_is_a_jaws_length_along_the_tool_and_scaled_with_the_rest() -> None:
    tip = pose((0.01, 0.02, 0.03), (180, 0, 0))  # straight down
    end = from_task(CELL, 0, Label("task", "jaw-end"), tip)
    assert end[:3, 3] - tip[:3, 3] == pytest.approx([0, 0, -0.0102])
    pivot, end = (from_task(CELL, 0, Label("surrol", p), tip)[2, 3] for p in CONTROL_POINTS)
    assert pivot - end == pytest.approx(5 * 0.0102)
    other = from_task(CELL, 0, Label("surrol", "jaw-pivot", 1.0), tip)[2, 3]
    assert pivot == pytest.approx(5 * other)


def test_a_cell_that_does_not_know_surrols_world_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    file: CellFile = CELL.file.model_copy(update={"surrol": None})
    cell = type(CELL)(CELL.name, CELL.arms, file, CELL.files)
    with pytest.raises(DataFileError, match="surrol"):
        to_task(cell, 0, Label("world", "jaw-pivot"), np.eye(4))
    assert to_task(cell, 0, Label("task", "jaw-pivot"), np.eye(4)) == pytest.approx(np.eye(4))


def test_a_label_says_what_it_means() -> None:
    assert str(Label("surrol", "jaw-end", 5.0)) == (
        "frame surrol, control point jaw-end, lengths x 5"
    )
    assert math.isclose(Label("task", "jaw-pivot").but(length_scale=2.0).length_scale or 0, 2.0)
