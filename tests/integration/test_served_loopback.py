"""What only the served loopback has: a second handle, and a life of its own."""

import os
import signal
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers import loopback_server
from viskill_deploy.drivers.base import DISABLED, ENABLED, PAUSED
from viskill_deploy.drivers.loopback_served import ServedLoopback
from viskill_deploy.drivers.loopback_stop import StopHandle
from viskill_deploy.sim.world import World, WorldOptions

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


def test_arms_that_a_second_handle_held_take_no_setpoint_until_they_are_enabled_again(
    driver: ServedLoopback,
) -> None:
    driver.enable()
    driver.home()
    until(driver, lambda: driver.state().arms[0].is_homed)
    handle = StopHandle(driver.path)
    handle.hold()
    until(driver, lambda: driver.state().arms[0].operating_state == PAUSED)
    arms = driver.state().arms
    line = driver._connected_line()
    rows = [[a.setpoint_jp, (0.0,) * 6, a.jaw_setpoint_jp + 0.1, 0.0] for a in arms]
    line.send({"do": "servo_jp", "setpoints": rows})
    with pytest.raises(DriverError, match="PAUSED"):
        until(driver, lambda: driver.state().arms[0].jaw_setpoint_jp != arms[0].jaw_setpoint_jp)
    assert driver.state().arms[0].setpoint_jp == arms[0].setpoint_jp
    driver.hold()  # the controlling client's own hold does not bring them back either
    assert driver.state().arms[0].operating_state == PAUSED
    driver.enable()
    until(driver, lambda: driver.state().arms[0].operating_state == ENABLED)
    line.send({"do": "servo_jp", "setpoints": rows})
    until(driver, lambda: driver.state().arms[0].jaw_setpoint_jp == rows[0][2])
    handle.close()


def test_a_handle_that_only_watches_sees_the_arms_and_who_stopped_them(
    driver: ServedLoopback,
) -> None:
    handle, answers = StopHandle(driver.path), list[dict]()

    def answered() -> bool:
        answers.extend(handle.answers())
        return bool(answers)

    handle.ask()
    until(driver, answered)
    assert answers[-1]["stopped_s"] == {}
    assert answers[-1]["state"]["arms"][0]["operating_state"] == DISABLED
    answers.clear()
    before = driver.clock.now()
    handle.hold()
    handle.hold()
    handle.ask()
    until(driver, answered)
    assert before <= answers[-1]["stopped_s"]["hold"] <= driver.clock.now()
    handle.close()


def test_nobody_takes_the_place_of_a_controlling_client_that_has_gone(
    driver: ServedLoopback,
) -> None:
    handle = StopHandle(driver.path)
    driver._connected_line()._socket.shutdown(socket.SHUT_RDWR)  # as when the runtime dies
    answers: list[dict] = []
    later = StopHandle(driver.path)

    def refused() -> bool:
        later.send({"do": "enable"})
        answers.extend(later.answers())
        return bool(answers)

    until(driver, refused)
    assert "may only" in answers[0]["error"]
    handle.close()
    later.close()
    driver.watch.close()
    assert driver.process is not None
    driver.process.wait(5.0)  # with its last client the server has gone


def test_a_server_that_nobody_controls_ends(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(loopback_server, "LONELY_S", 0.05)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listener:
        listener.bind(str(tmp_path / "lonely.sock"))
        listener.listen()
        loopback_server.LoopbackServer(World(CELL, WorldOptions(period_s=0.01)), listener).run()


def test_a_driver_takes_its_watchdog_along(driver: ServedLoopback) -> None:
    inputs = driver.state().inputs
    assert abs(driver.clock.now() - inputs.watchdog_stamp_s) < 1.0
    assert inputs.watchdog_stepped_in is False
    watchdog = driver.watch.process
    assert watchdog.poll() is None
    driver.close()
    assert watchdog.returncode is not None
    with pytest.raises(DriverError, match="connect"):
        driver.watch  # noqa: B018


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
