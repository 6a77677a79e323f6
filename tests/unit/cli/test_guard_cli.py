"""`viskill guard` at the command line: what it insists on before it connects to anything."""

from pathlib import Path

import pytest
from calibrations import write_fresh
from lab_files import with_serials
from typer.testing import CliRunner

from viskill_deploy.cli.main import app
from viskill_deploy.core.description import CellDescription, load_cell
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
    assert "calibrate the cell again" in refusal("--simulated", "--calibration", str(old))


def test_a_calibration_of_another_cell_is_refused(tmp_path: Path) -> None:
    other = write_fresh(tmp_path / "cell.json", load_cell("matchboardpanel"))
    assert "not 'bipegtransfer'" in refusal("--simulated", "--calibration", str(other))


def test_arms_with_serial_numbers_need_their_calibration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = tmp_path / "lab.toml"
    lab.write_text(with_serials("bipegtransfer"), encoding="utf-8")
    assert "--calibration" in refusal("--cell", str(lab))


@pytest.fixture
def connections(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the cells whose robot the guard has tried to connect to."""
    seen: list[str] = []

    def connect(cell: CellDescription, *_: object) -> None:
        seen.append(cell.name)
        raise DriverError("enough")

    monkeypatch.setattr("viskill_deploy.cli.guard.connect", connect)
    return seen


def test_a_cell_of_simulated_arms_does_not_guard_a_robot(
    connections: list[str], tmp_path: Path
) -> None:
    """With a calibration of simulated arms or without one, named or by default."""
    fresh = write_fresh(tmp_path / "cell.json", load_cell("bipegtransfer"))
    for words in ((), ("--cell", "bipegboard"), ("--calibration", str(fresh))):
        said = refusal(*words)
        assert "its arms are simulated" in said
        for way_out in ("--robot", "serial numbers", "--calibration", "--simulated"):
            assert way_out in said
    assert connections == []


def test_a_simulated_robot_is_guarded_by_its_simulated_cell(connections: list[str]) -> None:
    run = CliRunner().invoke(app, ["guard", "--simulated", "--cell", "bipegboard"])
    assert "enough" in str(run.exception)
    assert connections == ["bipegboard"]


def test_a_cell_with_serial_numbers_and_its_calibration_need_no_more_words(
    connections: list[str], tmp_path: Path
) -> None:
    lab = tmp_path / "lab.toml"
    lab.write_text(with_serials("bipegtransfer"), encoding="utf-8")
    measured = write_fresh(tmp_path / "lab.json", load_cell(str(lab)))
    words = ["guard", "--cell", str(lab), "--calibration", str(measured)]
    assert "enough" in str(CliRunner().invoke(app, words).exception)
    assert connections == ["bipegtransfer"]


def test_real_arms_are_not_called_simulated(connections: list[str], tmp_path: Path) -> None:
    lab = tmp_path / "lab.toml"
    lab.write_text(with_serials("bipegtransfer"), encoding="utf-8")
    run = CliRunner().invoke(app, ["guard", "--cell", str(lab), "--simulated"])
    assert run.exit_code == 2
    assert "leave it out" in " ".join(run.output.replace("│", " ").split())
    assert connections == []


def test_the_console_is_named_at_the_command_line(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[CrtkOptions] = []

    def connect(cell: object, carrier: str, network: object, options: CrtkOptions) -> None:
        seen.append(options)
        raise DriverError("enough")

    monkeypatch.setattr("viskill_deploy.cli.guard.connect", connect)
    monkeypatch.setattr("viskill_deploy.drivers.crtk.robot.connect", connect)
    CliRunner().invoke(app, ["guard", "--simulated", "--console", "console2", "--rate", "500"])
    with pytest.raises(DriverError, match="enough"):
        connected(load_cell("bipegtransfer"), RobotOptions("crtk", console="console2"))
    assert [options.console for options in seen] == ["console2", "console2"]
    assert seen[0].period_s == 0.002
