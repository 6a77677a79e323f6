"""What only the served loopback has: a second handle, and a life of its own."""

import os
import signal
from collections.abc import Callable, Iterator

import pytest

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.base import DISABLED, ENABLED
from viskill_deploy.drivers.loopback_served import ServedLoopback
from viskill_deploy.drivers.loopback_stop import StopHandle
from viskill_deploy.sim.world import WorldOptions

CELL = load_cell("bipegtransfer")


@pytest.fixture
def driver() -> Iterator[ServedLoopback]:
    made = ServedLoopback(CELL, WorldOptions(period_s=0.01))
    made.connect()
    yield made
    made.close()


def until(driver: ServedLoopback, true: Callable[[], bool]) -> None:
    for _ in range(200):
        if true():
            return
        driver.clock.sleep_until(driver.clock.now() + 0.01)
    raise AssertionError("it did not happen")


def test_a_second_handle_may_disable(driver: ServedLoopback) -> None:
    driver.enable()
    until(driver, lambda: driver.state().arms[0].operating_state == ENABLED)
    handle = StopHandle(driver.path)
    handle.hold()
    handle.disable()
    until(driver, lambda: driver.state().arms[0].operating_state == DISABLED)
    handle.close()


def test_a_second_handle_may_do_nothing_else(driver: ServedLoopback) -> None:
    handle = StopHandle(driver.path)
    for verb in ("enable", "home", "servo_jp", "reset", "say", "stop"):
        handle.send({"do": verb})
    answers: list[object] = []

    def all_refused() -> bool:
        answers.extend(handle.answers())
        return len(answers) == 6

    until(driver, all_refused)
    assert all("may only" in str(answer) for answer in answers)
    assert driver.state().arms[0].operating_state == DISABLED
    handle.close()


def test_a_killed_server_is_a_driver_error(driver: ServedLoopback) -> None:
    assert driver.process is not None
    os.kill(driver.process.pid, signal.SIGKILL)
    driver.process.wait()
    with pytest.raises(DriverError):
        for _ in range(100):
            driver.state()
            driver.clock.sleep_until(driver.clock.now() + 0.01)


def test_nonsense_on_the_socket_ends_only_that_connection(driver: ServedLoopback) -> None:
    handle = StopHandle(driver.path)
    handle._line._socket.send(b"\xff\x00nonsense\n[1, 2]\n")
    driver.clock.sleep_until(driver.clock.now() + 0.1)
    assert driver.state().arms
    with pytest.raises(DriverError):
        for _ in range(50):
            handle.answers()
            driver.clock.sleep_until(driver.clock.now() + 0.01)
    handle.close()
