"""Every fault in every phase of a task, stepped: the declared reaction in the declared time."""

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from fault_cells import PHASES, STRIKE_S, complaints, phases, prepared, run_cell

from viskill_deploy.core.types import Mode
from viskill_deploy.drivers.loopback import LoopbackDriver
from viskill_deploy.observe.reading import read_recording
from viskill_deploy.observe.recording import Recorder
from viskill_deploy.runtime.faults import FAULTS, TOLERATED

OWN_PROCESS = ("kill-runtime", "recorder-full")
"""Faults that need a recorder, or a runtime, in a process of its own."""

BY_NAME = {fault.name: fault for fault in FAULTS}


@pytest.fixture(scope="module")
def world() -> LoopbackDriver:
    return LoopbackDriver(prepared().cell)


@pytest.fixture
def driver(world: LoopbackDriver) -> Iterator[LoopbackDriver]:
    world.connect()
    yield world
    world.break_drive("", "mended")
    world.close()


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("name", [name for name in BY_NAME if name not in OWN_PROCESS])
@pytest.mark.invariant("S34")
def test_each_fault_in_each_phase_has_its_declared_reaction(driver, name, phase) -> None:
    fault, moment = BY_NAME[name], phases()[phase]
    cell = run_cell(driver, moment, fault)
    assert complaints(cell, moment.declared(fault)) == []
    if cell.facts["seen_action"] == "FAULT":
        assert cell.mode is Mode.FAULT
    if cell.facts["seen_action"] == "ESTOP":
        assert cell.mode is Mode.ESTOPPED


@pytest.mark.parametrize("jump_s", [3600.0, -3600.0, 86400.0, -86400.0])
@pytest.mark.invariant("S21")
def test_a_jump_of_the_date_changes_nothing(driver, monkeypatch, jump_s: float) -> None:
    date, reads = time.time, iter(range(1_000_000))
    monkeypatch.setattr(time, "time", lambda: date() + jump_s * (next(reads) % 2))
    cell = run_cell(driver, phases()["lift"], BY_NAME["duplicate"])
    assert complaints(cell, TOLERATED) == []


class Paced(Recorder):
    """A recorder that lets simulated time pass no faster than real time, which its writer knows."""

    def cycle(self, *args) -> None:
        super().cycle(*args)
        time.sleep(0.003)


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.invariant("S32")
def test_a_full_disk_ends_the_run_in_each_phase(driver, tmp_path: Path, phase: str) -> None:
    fault, moment = BY_NAME["recorder-full"], phases()[phase]
    recorder = Paced(tmp_path / "bag", prepared().cell, driver.period_s)
    recorder.wait_until_open()
    cell = run_cell(driver, moment, fault, recorder)
    assert complaints(cell, moment.declared(fault)) == []
    with pytest.raises(OSError, match="free disk space"):
        recorder.close()
    assert not read_recording(tmp_path / "bag").complete


@pytest.mark.parametrize("name", [name for name in BY_NAME if name not in OWN_PROCESS])
@pytest.mark.invariant("S32")
def test_the_record_of_a_run_with_any_fault_opens_and_is_complete(driver, tmp_path, name) -> None:
    with Recorder(tmp_path / "bag", prepared().cell, driver.period_s) as recorder:
        recorder.wait_until_open()
        cell = run_cell(driver, phases()["lift"], BY_NAME[name], recorder)
    data = read_recording(tmp_path / "bag")
    assert data.complete
    cycles = len(data.joints["/PSM1/setpoint_js"].time_s)  # whose clock a fault may set back
    assert cycles * driver.period_s > STRIKE_S
    assert not cell.cause or cell.cause in {row.rule for row in data.verdicts}


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.invariant("S32")
def test_a_killed_runtime_leaves_a_complete_record_in_each_phase(driver, tmp_path, phase) -> None:
    bag, moment = tmp_path / "bag", phases()[phase]
    child = os.fork()
    if child == 0:
        try:
            recorder = Recorder(bag, prepared().cell, driver.period_s)
            recorder.wait_until_open()
            run_cell(driver, moment, BY_NAME["kill-runtime"], recorder)
        finally:
            os._exit(70)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    deadline = time.monotonic() + 10.0
    while not (bag / "metadata.yaml").exists():
        assert time.monotonic() < deadline, "the recorder did not close the record"
        time.sleep(0.01)
    data = read_recording(bag)
    assert data.complete
    times = data.joints["/PSM1/measured_js"].time_s
    assert times[-1] - times[0] == pytest.approx(STRIKE_S, abs=1.5 * driver.period_s)
