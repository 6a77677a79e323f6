"""The calibration that comes with the package: used as it is, refused with a byte changed.

`make wheel-check` dry-runs with it.
"""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from viskill_deploy.cli.main import main
from viskill_deploy.core.calibration_files import CalibrationFile, is_simulated, read_calibration
from viskill_deploy.core.data import packaged_roots
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.sealed import sealed
from viskill_deploy.runtime.preflight import Sources, prepare

pytestmark = pytest.mark.invariant("S27")

ROOT = Path(__file__).resolve().parents[2]
BUNDLE = ROOT / "policies/bipegtransfer-viskill"
NAME = Path("calibration/loopback_example.json")
EXAMPLE = ROOT / NAME
YEARS = 4e9
"""A day in the next century."""


def test_it_is_used_years_later_and_from_anywhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # as a package that is installed
    assert ROOT in packaged_roots()
    prepared = prepare(Sources(BUNDLE, calibration=NAME, date_s=YEARS))
    assert str(EXAMPLE) in {path for path, _ in prepared.files}
    (line,) = [line for line in prepared.lines if line.name == "calibration"]
    assert line.text.startswith("of simulated arms, residual")
    filed = prepared.cell.filed
    assert filed is not None
    for found, nominal in zip(prepared.cell.arms, filed.arms, strict=True):
        assert np.linalg.norm(found.T_task_base[:3, 3] - nominal.T_task_base[:3, 3]) < 1e-3


def test_only_simulated_arms_do_not_age() -> None:
    content = read_calibration(EXAMPLE).model_dump(mode="json", by_alias=True)
    assert content["simulated"]
    assert is_simulated(load_cell(content["cell"]))
    content["arms"][1]["serial"] = "29662"
    with pytest.raises(ValueError, match="PSM2 has a serial number"):
        CalibrationFile.model_validate(content)


def flipped(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(bytes(content))


def resealed(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def edit(path: Path) -> None:
        content = json.loads(path.read_text())
        change(content)
        path.write_text(sealed(content))

    return edit


SPOILED: dict[str, tuple[Callable[[Path], None], str]] = {
    "a flipped byte": (flipped, "is not readable|was changed after it was written"),
    "another serial number": (
        resealed(lambda c: [c.pop("simulated"), c["arms"][0].update(serial="29662")]),
        "was made for PSM1 .*29662.*the cell holds",
    ),
    "an old schema": (resealed(lambda c: c.update(schema=0)), "schema"),
    "a date in the past": (
        resealed(lambda c: c.update(simulated=False, created="2020-01-01T00:00:00Z")),
        "days old",
    ),
}


@pytest.mark.parametrize(("spoil", "words"), SPOILED.values(), ids=SPOILED.keys())
def test_a_dry_run_with_a_spoiled_one_exits_with_3(
    spoil: Callable[[Path], None],
    words: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = Path(shutil.copy(EXAMPLE, tmp_path / "cell.json"))
    spoil(path)
    command = ["viskill", "dry-run", str(BUNDLE), "--calibration", str(path)]
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 3
    said = capsys.readouterr()
    assert re.search(words, said.out + said.err)
    assert "cell.json" in said.out + said.err
