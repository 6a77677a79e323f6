"""Every fault in every phase of a task on the served loopback, against the clock.

A trial in which the machine took the processor away from the control loop (an overrun) may be
repeated twice, and so may one whose runtime's process is killed or stopped, since that process
cannot tell of overruns; thresholds and times are those that are declared.
"""

import os
import pickle
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fault_cells import PHASES, STRIKE_S, Cell, complaints, phases, prepared, run_cell

from viskill_deploy.drivers.base import DISABLED, PAUSED
from viskill_deploy.drivers.loopback_served import ServedLoopback
from viskill_deploy.drivers.loopback_stop import StopHandle
from viskill_deploy.drivers.loopback_wire import unpack_state
from viskill_deploy.observe.reading import read_recording
from viskill_deploy.observe.recording import Recorder
from viskill_deploy.runtime.faults import FAULTS

pytestmark = pytest.mark.faults

BY_NAME = {fault.name: fault for fault in FAULTS}
APART = ("kill-runtime", "sigstop")
"""Faults of the runtime's process: it is a child of the test's."""
TRIALS = 3


@pytest.fixture
def made(request: pytest.FixtureRequest) -> Iterator[Callable[[], ServedLoopback]]:
    drivers = []

    def make() -> ServedLoopback:
        drivers.append(ServedLoopback(prepared().cell))
        return drivers[-1]

    yield make
    for driver in drivers:
        driver.close()


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("name", [name for name in BY_NAME if name not in APART])
def test_each_fault_has_its_declared_reaction_in_real_time(made, tmp_path, name, phase) -> None:
    fault, moment = BY_NAME[name], phases()[phase]
    for trial in range(TRIALS):
        driver, recorder = made(), None
        driver.connect()
        if name == "recorder-full":
            recorder = Recorder(tmp_path / f"bag{trial}", prepared().cell, driver.period_s)
            recorder.wait_until_open()
        cell = run_cell(driver, moment, fault, recorder)
        driver.close()
        if recorder is not None:
            with pytest.raises(OSError, match="free disk space"):
                recorder.close()
            assert not read_recording(tmp_path / f"bag{trial}").complete
        wrong = complaints(cell, moment.declared(fault))
        if not wrong or not cell.overruns:
            break
    assert wrong == [], f"{cell.overruns} overruns"


def in_a_child(work: Callable[[], object], result: Path) -> int:
    """Does work in a fork; what it returns goes to a file. Returns the process id."""
    child = os.fork()
    if child:
        return child
    try:
        result.write_bytes(pickle.dumps(work()))
        os._exit(0)
    finally:
        os._exit(70)


@pytest.mark.parametrize("phase", PHASES)
def test_a_runtime_that_was_stopped_for_a_second_moves_nothing(made, tmp_path, phase) -> None:
    fault, moment = BY_NAME["sigstop"], phases()[phase]
    for trial in range(TRIALS):
        driver, result = made(), tmp_path / f"cell{trial}"

        def work(driver: ServedLoopback = driver) -> Cell:
            driver.connect()
            cell = run_cell(driver, moment, fault)
            driver.close()
            return cell

        status = os.waitpid(in_a_child(work, result), 0)[1]
        assert os.waitstatus_to_exitcode(status) == 0
        cell = pickle.loads(result.read_bytes())
        wrong = complaints(cell, moment.declared(fault))
        if not wrong:
            break
    assert wrong == [], f"{cell.overruns} overruns"


@pytest.mark.parametrize("phase", PHASES)
def test_a_killed_runtime_leaves_held_arms_and_a_complete_record(made, tmp_path, phase) -> None:
    fault, moment = BY_NAME["kill-runtime"], phases()[phase]
    late = 0.0
    for trial in range(TRIALS):
        driver, bag = made(), tmp_path / f"bag{trial}"
        is_up, tell = os.pipe()

        def work(driver: ServedLoopback = driver, bag: Path = bag, tell: int = tell) -> None:
            driver.connect()
            recorder = Recorder(bag, prepared().cell, driver.period_s)
            recorder.wait_until_open()
            os.write(tell, b"!")
            run_cell(driver, moment, fault, recorder)

        child = in_a_child(work, tmp_path / "never")
        assert os.read(is_up, 1) == b"!"
        handle = StopHandle(driver.path)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
        late = watched_to_the_end(handle, time.monotonic())
        os.close(is_up)
        os.close(tell)
        check_record(bag)
        if late <= fault.reaction.within_s:
            break
    assert late <= fault.reaction.within_s


def watched_to_the_end(handle: StopHandle, killed_s: float) -> float:
    """Until the watchdog has taken the power; returns how long after the kill it held the arms."""
    stopped: dict[str, float] = {}
    held = None
    while "disable" not in stopped:
        assert time.monotonic() < killed_s + 5.0, "the watchdog does nothing"
        handle.ask()
        time.sleep(0.002)
        for answer in handle.answers():
            state, stopped = unpack_state(answer["state"]), answer["stopped_s"]
            if "hold" in stopped:
                now = [arm.setpoint_jp for arm in state.arms]
                held = held or now
                assert now == held, "held arms moved"
                assert all(arm.operating_state in {PAUSED, DISABLED} for arm in state.arms)
    handle.close()
    return stopped["hold"] - killed_s


def check_record(bag: Path) -> None:
    """The record was closed and reaches up to the kill."""
    deadline = time.monotonic() + 10.0
    while not (bag / "metadata.yaml").exists():
        assert time.monotonic() < deadline, "the recorder did not close the record"
        time.sleep(0.01)
    data = read_recording(bag)
    assert data.complete
    times = data.joints["/PSM1/measured_js"].time_s
    assert STRIKE_S - 0.012 <= times[-1] - times[0] <= STRIKE_S + 0.1
