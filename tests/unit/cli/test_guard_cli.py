"""`viskill guard` at the command line: what it insists on before it connects to anything."""

from pathlib import Path

import pytest
from calibrations import write_fresh
from lab_files import with_serials
from typer.testing import CliRunner

from viskill_deploy.cli.main import app
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import CalibrationError, DriverError
from viskill_deploy.drivers.crtk.driver import CrtkOptions
from viskill_deploy.runtime.robots import RobotOptions, connected

DAY_S = 86_400.0


def refusal(*arguments: str) -> str:
    run = CliRunner().invoke(app, ["guard", *arguments])
    assert isinstance(run.exception, CalibrationError)
    assert run.exception.exit_code == 3
    return str(run.exception)


def test_an_old_calibration_is_refused(tmp_path: Path) -> None:
    old = write_fresh(tmp_path / "cell.json", load_cell("bipegtransfer"), 40.0 * DAY_S)
    assert "calibrate the cell again" in refusal("--calibration", str(old))


def test_a_calibration_of_another_cell_is_refused(tmp_path: Path) -> None:
    other = write_fresh(tmp_path / "cell.json", load_cell("matchboardpanel"))
    assert "not 'bipegtransfer'" in refusal("--calibration", str(other))


def test_arms_with_serial_numbers_need_their_calibration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = tmp_path / "lab.toml"
    lab.write_text(with_serials("bipegtransfer"), encoding="utf-8")
    assert "--calibration" in refusal("--cell", str(lab))


def test_the_console_is_named_at_the_command_line(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[CrtkOptions] = []

    def connect(cell: object, carrier: str, network: object, options: CrtkOptions) -> None:
        seen.append(options)
        raise DriverError("enough")

    monkeypatch.setattr("viskill_deploy.cli.guard.connect", connect)
    monkeypatch.setattr("viskill_deploy.drivers.crtk.robot.connect", connect)
    CliRunner().invoke(app, ["guard", "--console", "console2", "--rate", "500"])
    with pytest.raises(DriverError, match="enough"):
        connected(load_cell("bipegtransfer"), RobotOptions("crtk", console="console2"))
    assert [options.console for options in seen] == ["console2", "console2"]
    assert seen[0].period_s == 0.002
