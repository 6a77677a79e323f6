from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from measured_arm import TYPICAL, cell_arm, measured

from viskill_deploy.calibrate.measurements import load, save
from viskill_deploy.core.errors import CalibrationError


def test_a_file_comes_back_bit_for_bit(tmp_path: Path) -> None:
    m, _ = measured(cell_arm(), TYPICAL, 20, seed=3)
    save(m, tmp_path / "m.csv")
    back = load(tmp_path / "m.csv", point_m=0.0102)
    for name in ("stamps", "joints", "speeds", "turns", "points"):
        np.testing.assert_array_equal(getattr(back, name), getattr(m, name))
    assert back.point_m == 0.0102


def test_speeds_and_turns_may_be_left_out_and_comments_be_there(tmp_path: Path) -> None:
    path = tmp_path / "m.csv"
    path.write_text(
        "# by hand\nx_m,y_m,z_m,note,stamp_s,q1_rad,q2_rad,q3_m,q4_rad,q5_rad,q6_rad\n"
        "0.1,0.2,0.3,left peg,7,1,2,0.1,4,5,6\n"
    )
    m = load(path)
    assert m.joints[0].tolist() == [1, 2, 0.1, 4, 5, 6]
    assert m.points[0].tolist() == [0.1, 0.2, 0.3]
    assert not m.speeds.any()
    assert not m.turns.any()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("stamp_s,q1_rad\n1,2\n", "q2_rad"),
        (
            "stamp_s,q1_rad,q2_rad,q3_m,q4_rad,q5_rad,q6_rad,x_m,y_m,z_m\n1,2,3,4,5,6,7,8,nine,0\n",
            "row 1, column 'y_m'",
        ),
        (
            "stamp_s,q1_rad,q2_rad,q3_m,q4_rad,q5_rad,q6_rad,x_m,y_m,z_m\n1,2,3\n",
            "row 1, column 'q3_m'",
        ),
    ],
)
def test_a_file_at_fault_is_refused_with_the_place(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "m.csv"
    path.write_text(text)
    with pytest.raises(CalibrationError, match=words):
        load(path)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="cannot be read"):
        load(tmp_path / "none.csv")
