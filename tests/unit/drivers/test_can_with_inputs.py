"""A consent and emergency-stop node on CAN, with drivers that know nothing of CAN."""

import os
from collections.abc import Callable, Iterator

import can
import numpy as np
import pytest
from typer.testing import CliRunner

from viskill_deploy.cli.main import app
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import DataFileError, DriverError
from viskill_deploy.core.types import Action, CellState, JointSetpoint, Request
from viskill_deploy.drivers import loopback
from viskill_deploy.drivers.base import Driver
from viskill_deploy.drivers.can.inputs import pack_input
from viskill_deploy.drivers.can.with_inputs import WithInputNode, load_inputs
from viskill_deploy.drivers.crtk import simulated as crtk
from viskill_deploy.runtime.driving import with_inputs
from viskill_deploy.safety.supervisor import Supervisor
from viskill_deploy.sim.tasks.base import load_task

CELL = load_cell("bipegtransfer")
CHANNEL = f"pedal-{os.getpid()}"
FILE = load_inputs("pedal").model_copy(update={"interface": "virtual", "channel": CHANNEL})
MOTION: dict[str, Callable[[], Driver]] = {
    "loopback": lambda: loopback.connect(CELL),
    "crtk": lambda: crtk.connect(CELL),
}


class Node:
    """The pedal, which says its word whenever a period passes."""

    def __init__(self) -> None:
        self.bus = can.Bus(interface="virtual", channel=CHANNEL)
        self.consent = self.estop = False
        self.words = 0

    def speak(self) -> None:
        self.words += 1
        word = pack_input(self.consent, self.estop, self.words)
        for identifier, data in ((0x180 + FILE.node_id, word), (0x700 + FILE.node_id, b"\5")):
            message = can.Message(arbitration_id=identifier, data=data, is_extended_id=False)
            self.bus.send(message)


@pytest.fixture
def node() -> Iterator[Node]:
    made = Node()
    yield made
    made.bus.shutdown()


@pytest.fixture(params=MOTION)
def driver(request: pytest.FixtureRequest, node: Node) -> Iterator[WithInputNode]:
    made = WithInputNode(speaking(MOTION[request.param](), node), FILE)
    made.reset(load_task("bipegtransfer").sample_layout(np.random.default_rng(0), "reference"))
    yield made
    made.close()


def speaking(driver: Driver, node: Node) -> Driver:
    """The driver, in whose time the node speaks."""
    sleep = driver.clock.sleep_until

    def sleep_until(deadline_s: float) -> float:
        node.speak()
        return sleep(deadline_s)

    driver.clock.sleep_until = sleep_until  # type: ignore[method-assign]
    return driver


def wait(driver: Driver, periods: int = 10) -> CellState:
    for _ in range(periods):
        driver.clock.sleep_until(driver.clock.now() + driver.period_s)
        state = driver.state()
    return state


def test_only_the_nodes_consent_lets_the_arms_move(driver: WithInputNode, node: Node) -> None:
    driver.enable()
    driver.home()
    driver.say(consent=True)  # the simulated operator's does not count any more
    gate = Supervisor(CELL, driver.period_s)
    gate.connect(state := wait(driver, 50))
    assert not state.inputs.consent
    assert gate.arm(state, driver.clock.now()) != ()
    node.consent = True
    gate.connect(state := wait(driver))
    assert (state.inputs.consent, state.inputs.consent_source) == (True, "CAN input node")
    assert gate.arm(state, driver.clock.now()) == ()
    stay = tuple(
        JointSetpoint(a.setpoint_jp, (0.0,) * 6, a.jaw_setpoint_jp, 0.0) for a in state.arms
    )

    def action() -> Action:
        decision = gate.check(wait(driver, 1), Request(stay), driver.clock.now())
        driver.servo_jp(decision.setpoints)
        driver.watch.beat(driver.clock.now())
        return decision.action

    assert all(action() < Action.HOLD for _ in range(20))
    node.consent = False
    within = round(0.3 / driver.period_s)  # 0.2 s of S22, and the way
    assert any(action() >= Action.HOLD for _ in range(within))


def test_either_emergency_stop_counts(driver: WithInputNode, node: Node) -> None:
    driver.enable()
    driver.home()
    assert not wait(driver, 50).inputs.estop
    node.estop = True
    assert wait(driver).inputs.estop
    node.estop = False
    assert not wait(driver).inputs.estop
    driver.say(estop=True)
    assert wait(driver, 50).inputs.estop


def test_a_silent_node_is_an_emergency_stop(driver: WithInputNode, node: Node) -> None:
    node.consent = True
    assert wait(driver).inputs.consent
    node.speak = lambda: None  # type: ignore[method-assign]
    state = wait(driver, round(0.1 / driver.period_s) + 2)
    assert state.inputs.estop
    assert not state.inputs.consent


def test_a_lost_bus_of_the_node_is_a_named_error(driver: WithInputNode, node: Node) -> None:
    frame = can.Message(arbitration_id=0x40, data=bytes(8), is_error_frame=True)
    node.bus.send(frame)
    with pytest.raises(DriverError, match="bus of input node 64 is off"):
        driver.state()


def test_a_node_that_says_nothing_refuses_the_connection_and_lets_the_driver_go(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    motion = loopback.connect(CELL)
    monkeypatch.setattr("viskill_deploy.drivers.can.with_inputs.load_inputs", lambda name: FILE)
    with pytest.raises(DriverError, match=r"input node 64 on virtual .* says nothing"):
        with_inputs(motion, "can:pedal")
    with pytest.raises(DriverError, match="not connected"):
        motion.state()


def test_inputs_of_another_kind_or_without_a_file_are_refused() -> None:
    for text in ("usb:pedal", "can", "can:"):
        with pytest.raises(DriverError, match="write can:FILE"):
            with_inputs(loopback.connect(CELL), text)
    with pytest.raises(DataFileError, match="nowhere"):
        with_inputs(loopback.connect(CELL), "can:nowhere")
    motion = loopback.connect(CELL)
    assert with_inputs(motion, "") is motion
    told = CliRunner().invoke(
        app, ["dry-run", "policies/bipegtransfer-viskill", "--inputs", "can:pedal"]
    )
    assert told.exit_code == 2
    assert "--realtime" in told.output
