"""What people see of a calibration."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from measured_arm import TYPICAL, measured

from viskill_deploy.calibrate.fit import fit_arm
from viskill_deploy.calibrate.judge import expected_errors, judge, work_places
from viskill_deploy.core.description import load_cell
from viskill_deploy.observe.calibration_report import write_calibration_report

CELL = load_cell("bipegtransfer")


@pytest.mark.parametrize("name", ["bipegtransfer", "bipegboard", "matchboardpanel"])
def test_the_work_lies_in_the_workspace(name: str) -> None:
    cell = load_cell(name)
    for arm in cell.arms:
        places = work_places(cell, arm)
        assert len(places) >= 1
        assert (places >= np.array(arm.entry.workspace_lower_m)).all()
        assert (places <= np.array(arm.entry.workspace_upper_m)).all()


def test_few_points_promise_less_than_many() -> None:
    expected = []
    for n in (10, 150):
        m, _ = measured(CELL.arms[0], TYPICAL, n, seed=0)
        fit = fit_arm(CELL.arms[0], m)
        expected.append(expected_errors(CELL, 0, fit, work_places(CELL, CELL.arms[0])))
    assert np.nanmedian(expected[0]) > 3 * np.nanmedian(expected[1])
    assert np.nanmedian(expected[1]) < 3e-4


def test_the_delay_shows_as_the_lowest_point_of_its_curve() -> None:
    m, _ = measured(CELL.arms[0], replace(TYPICAL, delay_s=0.04), 150, seed=1)
    judged = judge(CELL, 0, m, fit_arm(CELL.arms[0], m))
    lowest = judged.delay_s[np.argmin(judged.delay_rms_m)]
    assert lowest == pytest.approx(0.04, abs=0.005)


def test_the_page_tells_what_the_data_do_not(tmp_path: Path) -> None:
    m, _ = measured(CELL.arms[0], TYPICAL, 60, seed=2, wrong=0.1)
    still = replace(m, speeds=np.zeros((60, 6)))
    judged = [judge(CELL, 0, each, fit_arm(CELL.arms[0], each)) for each in (m, still)]
    page = write_calibration_report(tmp_path / "c.html", CELL.name, judged).read_text()
    assert "not told by the data" in page
    assert f"rows {', '.join(str(row + 1) for row in np.flatnonzero(judged[0].is_outlier))}" in page
    assert judged[1].delay_s.size == 0
    assert "http://" not in page.split("<script>")[0]
