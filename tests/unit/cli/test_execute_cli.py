"""`viskill execute` at the command line: what it insists on before anything is switched on."""

import os
import time
from pathlib import Path

import pytest
from calibrations import write_fresh
from rich.console import Console
from typer.testing import CliRunner

from viskill_deploy.cli.execute import _agree, _height
from viskill_deploy.cli.main import app
from viskill_deploy.cli.terminal import Terminal
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import CalibrationError, Interrupted
from viskill_deploy.drivers import loopback
from viskill_deploy.runtime import execution
from viskill_deploy.runtime.checklist import Checklist
from viskill_deploy.runtime.execution import ExecuteOptions
from viskill_deploy.runtime.preflight import Prepared, Sources, prepare

ROOT = Path(__file__).resolve().parents[3]
BUNDLE = ROOT / "policies/bipegtransfer-viskill"


def test_without_a_calibration_nothing_is_even_connected() -> None:
    run = CliRunner().invoke(app, ["execute", str(BUNDLE)])
    assert isinstance(run.exception, CalibrationError)
    assert run.exception.exit_code == 3
    assert "name it with --calibration" in str(run.exception)


@pytest.mark.parametrize("stage", [["--rehearse"], ["--air", "30mm"]])
def test_what_holds_nothing_runs_a_plan(stage: list[str]) -> None:
    run = CliRunner().invoke(app, ["execute", str(BUNDLE), "--mode", "closed-loop", *stage])
    assert run.exit_code == 2


@pytest.mark.parametrize(
    ("text", "metres"), [("30mm", 0.03), ("3 cm", 0.03), ("0.03m", 0.03), ("12.5 mm", 0.0125)]
)
def test_a_height_has_its_unit(text: str, metres: float) -> None:
    assert _height(text) == pytest.approx(metres)


@pytest.mark.parametrize("text", ["30", "-30mm", "thirty mm", "30mm2", "mm"])
def test_a_height_without_a_unit_or_sense_is_a_wrong_use(text: str) -> None:
    run = CliRunner().invoke(app, ["execute", str(BUNDLE), f"--air={text}"])
    assert run.exit_code == 2
    assert "30mm" in run.output


@pytest.fixture
def prepared(tmp_path: Path) -> Prepared:
    calibration = write_fresh(tmp_path / "cell.json", load_cell("bipegtransfer"))
    return prepare(Sources(BUNDLE, calibration=calibration, date_s=time.time()))


def agreed(prepared: Prepared, typed: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """What the person read, after they typed something."""
    monkeypatch.setattr("viskill_deploy.cli.execute.look_before", lambda *a: Checklist())
    read, write = os.pipe()
    os.write(write, typed.encode())
    console = Console(record=True, width=200, quiet=False)
    with os.fdopen(read) as lines:
        terminal = Terminal(console, 0.01, lines)
        driver = loopback.connect(prepared.cell)
        try:
            _agree(prepared, ExecuteOptions(), driver, None, terminal, console, False)
        finally:
            os.close(write)
            driver.close()
    return console.export_text()


def test_a_person_has_to_type_the_bundles_name(
    prepared: Prepared, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = agreed(prepared, "bipegtransfer-viskill\n", monkeypatch)
    assert "PSM1 and PSM2 are enabled and homed" in text
    assert "at 25 % of full speed" in text
    assert "type bipegtransfer-viskill to go on" in text
    with pytest.raises(Interrupted, match="nothing was switched on"):
        agreed(prepared, "yes\n", monkeypatch)
    assert execution.FIRST_SPEED == 0.25


def test_an_operator_answers_by_lines_however_they_arrive() -> None:
    read, write = os.pipe()
    with os.fdopen(read) as lines:
        terminal = Terminal(Console(quiet=True), 0.0, lines)
        assert terminal.answer() is None
        os.write(write, b"go")
        assert terminal.answer() is None
        os.write(write, b" on\n\nn\n")
        assert [terminal.answer() for _ in range(4)] == ["go on", "", "n", None]
        os.close(write)
        with pytest.raises(Interrupted, match="nobody is at the terminal"):
            terminal.answer()
