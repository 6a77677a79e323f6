"""Files of numpy arrays: whole ones are read, everything else is refused with a sentence."""

import zipfile
from pathlib import Path

import numpy as np
import pytest

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import MotionError
from viskill_deploy.motion.frames import Label
from viskill_deploy.motion.trajectory import waypoints_of
from viskill_deploy.observe.trajectory_files import read_written

CELL = load_cell("bipegtransfer")


def test_an_npz_with_objects_or_without_numbers_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "bad.npz"
    np.savez(path, **{"PSM1/position": np.array([object()], dtype=object)})
    with pytest.raises(MotionError, match="plain arrays"):
        read_written(path)
    np.savez(path, **{"PSM1/position": np.zeros((1, 3))})
    with pytest.raises(MotionError, match="PSM1/quaternion"):
        read_written(path)
    path.write_bytes(b"no zip")
    with pytest.raises(MotionError, match="npz"):
        read_written(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as bomb:
        bomb.writestr("a.npy", bytes(10**6))
    monkeypatch.setattr("viskill_deploy.observe.trajectory_files.MAX_BYTES", 10**5)
    with pytest.raises(MotionError, match="too large"):
        read_written(path)
    monkeypatch.undo()
    shapes = {"position": (2, 3), "quaternion": (2, 3), "jaw": (2,)}
    wrong = {f"{a}/{k}": np.ones(s) for a in ("PSM1", "PSM2") for k, s in shapes.items()}
    np.savez(path, **wrong)
    with pytest.raises(MotionError, match="for 2 waypoints"):
        waypoints_of(CELL, read_written(path), Label("task", "jaw-pivot"), None, "bad.npz")


def whole(count: int) -> dict[str, np.ndarray]:
    """The arrays of a file of two arms."""
    shapes = {"position": (count, 3), "quaternion": (count, 4), "jaw": (count,)}
    return {f"{a}/{k}": np.full(s, 0.5) for a in ("PSM1", "PSM2") for k, s in shapes.items()}


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"time_s": np.arange(3.0)}, r"times have the shape \(3,\) for 2 waypoints"),
        ({"time_s": np.zeros((2, 1))}, r"times have the shape \(2, 1\) for 2 waypoints"),
        ({"time_s": np.array(0.2)}, r"times have the shape \(\)"),
        ({"time_s": np.array(["0.0", "0.2"])}, "lacks the numbers time_s"),
        ({"PSM1/jaw": np.array(0.5)}, "PSM1 has"),
        ({"PSM2/jaw": np.array(0.5)}, "PSM2 has"),
        ({"PSM1/jaw": np.zeros((2, 1))}, "PSM1 has"),
    ],
)
@pytest.mark.parametrize("step_s", [None, 0.2])
def test_an_npz_with_arrays_of_another_shape_is_refused(
    tmp_path: Path, change: dict[str, np.ndarray], match: str, step_s: float | None
) -> None:
    path = tmp_path / "bad.npz"
    np.savez(path, **(whole(2) | change))
    with pytest.raises(MotionError, match=match):
        waypoints_of(CELL, read_written(path), Label("task", "jaw-pivot"), step_s, "bad.npz")


def test_a_damaged_npz_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.npz"
    np.savez_compressed(path, **whole(200))
    good = path.read_bytes()
    for at in range(0, len(good), 7):
        path.write_bytes(good[:at] + bytes([good[at] ^ 0xFF]) + good[at + 1 :])
        try:
            read_written(path)
        except MotionError:
            continue
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("PSM1/position", b"no array")
    with pytest.raises(MotionError, match="PSM1/position"):
        read_written(path)
