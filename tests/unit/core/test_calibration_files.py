"""A calibration is used for the arms that it was made for, or refused with what to do."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibrations import CREATED, calibration_of

from viskill_deploy.core.calibration_files import (
    calibrated,
    is_simulated,
    read_calibration,
    write_calibration,
)
from viskill_deploy.core.description import load_cell, rpy_matrix
from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.core.sealed import sealed

pytestmark = pytest.mark.invariant("S27")

CELL = load_cell("bipegtransfer")
Edit = Callable[[dict[str, Any]], Any]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write_calibration(tmp_path / "cell.json", calibration_of(CELL))


def edited(path: Path, edit: Edit) -> Path:
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(sealed(content))
    return path


def test_a_calibration_is_read_as_it_was_written(path: Path) -> None:
    read = read_calibration(path)
    assert read.created == CREATED
    assert read.model_copy(update={"digest": ""}) == calibration_of(CELL)


def test_the_arms_and_their_ports_stand_where_it_says(path: Path) -> None:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rpy_matrix(0.01, -0.02, -1.9), (-0.04, 0.07, 0.15)

    def move(content: dict[str, Any]) -> None:
        content["arms"][0] |= {"T_task_base": T.tolist(), "port_in_base_m": [0.001, 0.0, -0.002]}

    cell = calibrated(CELL, read_calibration(edited(path, move)), path)
    np.testing.assert_array_equal(cell.arms[0].T_task_base, T)
    assert not cell.arms[0].T_task_base.flags.writeable
    assert cell.arms[0].port_in_base.tolist() == [0.001, 0.0, -0.002]
    np.testing.assert_array_equal(cell.arms[1].T_task_base, CELL.arms[1].T_task_base)
    assert cell.arms[1].port_in_base.tolist() == list(CELL.arms[1].entry.port_in_base_m)
    assert cell.files == (*CELL.files, path)


def put(key: str, value: Any) -> Edit:
    return lambda content: content["arms"][1].__setitem__(key, value)


@pytest.mark.parametrize(
    ("key", "value"),
    [("name", "PSM3"), ("robot", "psm_si"), ("serial", "29662"), ("tool", "other_tool")],
)
def test_that_of_other_arms_or_instruments_is_refused(path: Path, key: str, value: str) -> None:
    foreign = read_calibration(edited(path, put(key, value)))
    with pytest.raises(CalibrationError, match=value) as caught:
        calibrated(CELL, foreign, path)
    assert "calibrate the cell again" in str(caught.value)


def test_that_of_another_cell_or_another_number_of_arms_is_refused(path: Path) -> None:
    with pytest.raises(CalibrationError, match="elsewhere"):
        calibrated(CELL, calibration_of(CELL, cell="elsewhere"), path)
    alone = read_calibration(edited(path, lambda c: c["arms"].pop()))
    with pytest.raises(CalibrationError, match=r"the cell holds PSM1 .*, PSM2"):
        calibrated(CELL, alone, path)


def mirrored(content: dict[str, Any]) -> None:
    content["arms"][0]["T_task_base"][0][:3] = [
        -x for x in content["arms"][0]["T_task_base"][0][:3]
    ]


def bend(by: float) -> Edit:
    def edit(content: dict[str, Any]) -> None:
        content["arms"][0]["T_task_base"][1][2] += by

    return edit


BAD: dict[str, tuple[Edit, str]] = {
    "schema": (lambda c: c.__setitem__("schema", 0), "schema"),
    "unknown key": (lambda c: c.__setitem__("pickle", "x"), "pickle"),
    "no data hash": (lambda c: c.pop("data_sha256"), "data_sha256"),
    "short hash": (lambda c: c.__setitem__("data_sha256", "0" * 63), "data_sha256"),
    "no arms": (lambda c: c.__setitem__("arms", []), "arms"),
    "no zone": (lambda c: c.__setitem__("created", "2026-03-01T12:00:00"), "created"),
    "negative residual": (put("residual_rms_m", -1e-9), "arms.1.residual_rms_m"),
    "no samples": (put("samples", 0), "arms.1.samples"),
    "not orthonormal": (bend(1e-3), "arms.0.T_task_base: the rotation is not orthonormal"),
    "mirrored": (mirrored, "right-handed"),
    "last row": (lambda c: c["arms"][0]["T_task_base"][3].__setitem__(0, 0.1), "0 0 0 1"),
    "short row": (lambda c: c["arms"][0]["T_task_base"][3].pop(), "T_task_base"),
}


@pytest.mark.parametrize(("edit", "named"), BAD.values(), ids=BAD.keys())
def test_one_that_makes_no_sense_is_refused_and_the_entry_named(
    path: Path, edit: Edit, named: str
) -> None:
    with pytest.raises(CalibrationError, match=named) as caught:
        read_calibration(edited(path, edit))
    assert caught.value.exit_code == 3
    assert str(path) in str(caught.value)
    assert "calibrate the cell again" in str(caught.value)


def test_a_rotation_may_miss_by_the_rounding_of_its_print(path: Path) -> None:
    assert read_calibration(edited(path, bend(1e-8)))


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"No such file.*name a calibration"):
        read_calibration(tmp_path / "none.json")


def test_a_cell_with_one_real_arm_is_not_simulated() -> None:
    assert is_simulated(CELL)
    arm = CELL.arms[0]
    real = arm.entry.model_copy(update={"serial": "29662"})
    arms = (type(arm)(arm.name, arm.arm, arm.T_task_base, real), CELL.arms[1])
    assert not is_simulated(type(CELL)(CELL.name, arms, CELL.file, CELL.files))
