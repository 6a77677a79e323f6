"""`viskill serve can` and the driver that real arms get, in two processes, over `udp_multicast`."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from viskill_deploy.core import data, realtime
from viskill_deploy.core.errors import DataFileError, DriverError
from viskill_deploy.core.types import Action, CellState, JointSetpoint, Request
from viskill_deploy.drivers.can.config import load_can, load_with_cell
from viskill_deploy.drivers.can.driver import CanDriver
from viskill_deploy.drivers.can.serving import drive_cell, obey
from viskill_deploy.drivers.can.simulated import SteppedCan
from viskill_deploy.safety.supervisor import Supervisor

SAMPLE = data.find("robots/can/bipegtransfer.toml").read_text()


@pytest.fixture
def toml(tmp_path: Path) -> Path:
    """The sample on groups that no other test uses, slow enough for a busy machine."""
    path = tmp_path / "own.toml"
    group = f"239.80.{os.getpid() % 251}"
    text = SAMPLE.replace("239.74.163", group).replace("cycle_hz = 250", "cycle_hz = 100")
    text = text.replace("heartbeat_s = 0.05 ", "heartbeat_s = 0.3 ")
    path.write_text(text.replace('"virtual" ', '"udp_multicast"'))
    return path


IN_THE_BACKGROUND = ("sh", "-c", 'trap "" INT; exec "$0" "$@"')
"""A shell starts what it puts there with SIGINT ignored."""


class Served:
    """`viskill serve can` and who types there."""

    def __init__(self, toml: Path) -> None:
        command = [sys.executable, "-m", "viskill_deploy.cli.main", "serve", "can", str(toml)]
        pipe = subprocess.PIPE
        command = [*IN_THE_BACKGROUND, *command]
        self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, bufsize=1)
        self.said = self.until("serving until Ctrl-C")

    def until(self, word: str) -> list[str]:
        assert self.process.stdout is not None
        lines = []
        for line in self.process.stdout:
            lines.append(line.strip())
            if word in line:
                return lines
        raise AssertionError(f"it ended without {word!r}: {lines}")

    def type(self, order: str, answer: str = "done") -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(order + "\n")
        self.until(answer)


@pytest.fixture
def served(toml: Path) -> Iterator[Served]:
    made = Served(toml)
    yield made
    if made.process.poll() is None:
        made.process.kill()
    made.process.communicate()


def wait(driver: CanDriver, periods: int) -> CellState:
    """Time passes; what arrives is heard in every period, as a runtime does."""
    for _ in range(periods):
        driver.clock.sleep_until(driver.clock.now() + driver.period_s)
        state = driver.state()
    return state


def test_real_driver_and_served_drives_meet_move_and_part(served: Served, toml: Path) -> None:
    assert re.search(r"PSM1 on udp_multicast 239\.80\.\d+\.2, load 1\d%: yaw 1,", served.said[0])
    file, cell = load_with_cell(str(toml))
    driver = CanDriver(cell, file)
    driver.connect()
    try:
        realtime.prepare()  # before arms have power; and other tests do not hold it up
        driver.enable()
        driver.home()
        gate = Supervisor(cell, driver.period_s)
        gate.connect(state := wait(driver, 20))
        assert state.inputs.consent_source == "CAN"
        assert not (state.inputs.consent or state.inputs.estop)
        served.type("consent")
        gate.connect(state := wait(driver, 20))
        assert gate.arm(state, driver.clock.now()) == ()
        start = [arm.measured_jp for arm in state.arms]
        held = [
            JointSetpoint(a.setpoint_jp, (0.0,) * 6, a.jaw_setpoint_jp, 0.0) for a in state.arms
        ]
        for tick in range(50):
            s = (tick + 1) / 50
            turn = 0.004 * s**3 * (10 - 15 * s + 6 * s * s)
            yaw = held[0].jp[0] + turn
            wish = (replace(held[0], jp=(yaw, *held[0].jp[1:])), held[1])
            decision = gate.check(driver.state(), Request(wish), driver.clock.now())
            assert decision.action < Action.HOLD, decision.verdicts
            driver.servo_jp(decision.setpoints)
            driver.watch.beat(driver.clock.now())
            driver.clock.sleep_until(driver.clock.now() + driver.period_s)
        driver.watch.release()
        realtime.pause()
        moved = wait(driver, 20).arms[0].measured_jp[0] - start[0][0]
        assert moved == pytest.approx(0.004, abs=5e-4)
        np.testing.assert_allclose(wait(driver, 1).arms[1].measured_jp, start[1], atol=5e-4)
        served.process.send_signal(signal.SIGINT)
        served.until("the drives are gone")
        assert served.process.wait(5.0) == 0
        began = time.monotonic()
        with pytest.raises(DriverError, match=r"has not answered .* SYNCs|lost its heartbeat"):
            wait(driver, 150)
        assert time.monotonic() - began < 1.5
    finally:
        realtime.release()
        driver.close()


def test_the_operator_types_orders_and_a_wrong_one_is_answered_with_those_that_there_are() -> None:
    file, cell = load_with_cell("bipegtransfer")
    stepped = SteppedCan(cell, file)
    front = stepped.front
    try:
        for order in ("consent", "estop", "break PSM1/yaw stuck", "mend", "no estop"):
            obey(front, order)
        inputs = front.cell.state(0.0).inputs
        assert inputs.consent
        assert not inputs.estop
        obey(front, "no consent")
        assert not front.cell.state(1.0).inputs.consent
        for order in ("dance", "", "break PSM1/elbow stuck"):
            with pytest.raises(DriverError, match=r"type one of: consent|elbow"):
                obey(front, order)
    finally:
        stepped.close()


def test_virtual_buses_are_not_served_and_a_wrong_file_is_named(tmp_path: Path) -> None:
    file, cell = load_with_cell("bipegtransfer")
    with pytest.raises(DriverError, match="choose udp_multicast or socketcan"):
        drive_cell(cell, file)
    assert load_can("bipegtransfer", cell, "socketcan").interface == "socketcan"
    with pytest.raises(DataFileError, match=r"mine\.toml"):
        load_with_cell(str(tmp_path / "mine.toml"))
