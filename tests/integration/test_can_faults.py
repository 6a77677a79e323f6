"""Everything that a bus or a drive can do wrong, on simulated drives stepped on virtual buses.

Each fault ends in a named error and in drives at rest, within its declared time.
"""

from __future__ import annotations

import contextlib
import random
import struct
import threading
from collections.abc import Iterator

import can
import canopen
import numpy as np
import pytest

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import Action, CellState, JointSetpoint, Request
from viskill_deploy.drivers.can.axis import CLASSES
from viskill_deploy.drivers.can.codec import Drive
from viskill_deploy.drivers.can.config import load_can
from viskill_deploy.drivers.can.objects import axis_objects
from viskill_deploy.drivers.can.simulated import SteppedCan
from viskill_deploy.drivers.can.simulated_drive import POWERED, SimulatedDrive
from viskill_deploy.safety.supervisor import Supervisor
from viskill_deploy.sim.tasks.base import load_task
from viskill_deploy.sim.world import WorldOptions

CELL = load_cell("bipegtransfer")
FILE = load_can("bipegtransfer", CELL)
LAYOUT = load_task("bipegtransfer").sample_layout(np.random.default_rng(0), "reference")
PERIOD = 0.004
SAFETY_KEYS = sorted({o.key for o in axis_objects(FILE, FILE.bus[0].axis[0], PERIOD)})


@pytest.fixture
def driver() -> Iterator[SteppedCan]:
    made = SteppedCan(CELL, FILE)
    yield made
    made.close()


def wait(driver: SteppedCan, periods: int = 1) -> CellState:
    driver.clock.sleep_until(driver.clock.now() + periods * driver.period_s)
    return driver.state()


def armed(driver: SteppedCan) -> Supervisor:
    driver.connect()
    driver.reset(LAYOUT)
    driver.enable()
    driver.home()
    gate = Supervisor(CELL, driver.period_s)
    gate.connect(wait(driver, 10))
    driver.say(consent=True)
    state = wait(driver, 10)
    gate.connect(state)
    assert gate.arm(state, driver.clock.now()) == ()
    return gate


class Mover:
    """Turns PSM1's yaw steadily, through the gate, until something stops it."""

    def __init__(self, driver: SteppedCan, speed: float = 0.1) -> None:
        self.driver, self.gate, self.speed = driver, armed(driver), speed
        self.q = [a.setpoint_jp for a in driver.state().arms]
        self.jaw = [a.jaw_setpoint_jp for a in driver.state().arms]
        self.v = 0.0

    def cycle(self) -> None:
        driver, period = self.driver, self.driver.period_s
        self.v = min(self.v + 0.4 * period, self.speed)
        yaw = self.q[0][0] + self.v * period
        self.q[0] = (yaw, *self.q[0][1:])
        speeds = ((self.v, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0,) * 6)
        rows = zip(self.q, speeds, self.jaw, strict=True)
        wish = tuple(JointSetpoint(q, v, jaw, 0.0) for q, v, jaw in rows)
        decision = self.gate.check(driver.state(), Request(wish), driver.clock.now())
        assert decision.action < Action.HOLD, decision.verdicts
        driver.servo_jp(decision.setpoints)
        driver.watch.beat(driver.clock.now())
        driver.clock.sleep_until(driver.clock.now() + period)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / self.driver.period_s)):
            self.cycle()


def drives(driver: SteppedCan) -> list[SimulatedDrive]:
    return [drive for arm in driver.front.arms for drive in arm.drives]


def at_rest(driver: SteppedCan) -> bool:
    return all(drive.speed == 0.0 for drive in drives(driver)) and not any(
        drive.state is Drive.OPERATION_ENABLED for drive in drives(driver)
    )


def let_pass(driver: SteppedCan, seconds: float) -> None:
    """Time goes on for the drives alone: the runtime hangs."""
    for _ in range(round(seconds / PERIOD)):
        driver._time.world_s += PERIOD
        driver._time.advance(PERIOD)
        driver.front.advance(driver._time.world_s)


def trouble(driver: SteppedCan, within_s: float, moving: Mover | None = None) -> str:
    """The named error, which has to come in time."""
    start = driver.clock.now()
    with pytest.raises(DriverError) as caught:
        while driver.clock.now() < start + within_s + 1e-9:
            if moving is None:
                wait(driver)
            else:
                moving.cycle()
        raise AssertionError(f"nothing was noticed within {within_s} s")
    return str(caught.value)


def comes_to_rest(driver: SteppedCan, within_s: float = 0.05) -> None:
    for _ in range(round(within_s / PERIOD)):
        driver.clock.sleep_until(driver.clock.now() + PERIOD)
    assert at_rest(driver)
    for _ in range(3):  # the error stays, and nothing moves again
        with pytest.raises(DriverError):
            driver.state()
    places = [drive.demand for drive in drives(driver) if drive.state in POWERED]
    driver.clock.sleep_until(driver.clock.now() + 0.1)
    assert [drive.demand for drive in drives(driver) if drive.state in POWERED] == places


def stranger(driver: SteppedCan, arm: int = 0) -> can.BusABC:
    return can.Bus(interface="virtual", channel=driver.masters[arm].line._bus.channel_id)


def say(bus: can.BusABC, identifier: int, data: bytes, **kind: bool) -> None:
    bus.send(
        can.Message(arbitration_id=identifier, data=data, **({"is_extended_id": False} | kind))
    )


def test_when_syncs_stop_the_drives_stop_within_two_cycles_and_the_deadline(
    driver: SteppedCan,
) -> None:
    mover = Mover(driver)
    mover.run(0.5)
    ramp_s = 0.1 / 10.0
    let_pass(driver, FILE.watchdog_s + 2 * PERIOD + ramp_s + PERIOD)
    assert at_rest(driver)
    with pytest.raises(DriverError, match=r"0x8700 .*lost our SYNC"):
        driver.state()
    assert driver.watch.told(driver._input.inputs(0.0), 0.0).watchdog_stepped_in
    comes_to_rest(driver)


def test_when_targets_alone_stop_the_drives_stop(driver: SteppedCan) -> None:
    mover = Mover(driver)
    mover.run(0.2)
    for _ in range(round(FILE.watchdog_s / PERIOD) + 2):
        for master in driver.masters:
            for axis in master.axes:
                axis.unanswered += 1  # an answer is due
            master.line.send(0x080, b"")
        let_pass(driver, PERIOD)
    with pytest.raises(DriverError, match=r"0x8250 .*lost our target"):
        driver.state()
    comes_to_rest(driver)


def test_when_the_masters_heartbeat_alone_stops_the_drives_stop(driver: SteppedCan) -> None:
    mover = Mover(driver)
    for master in driver.masters:
        master._beat_due_s = np.inf
    said = trouble(driver, 3 * FILE.heartbeat_s + FILE.heartbeat_s + 2 * PERIOD, mover)
    assert "0x8130" in said
    comes_to_rest(driver)


def test_a_lost_heartbeat_of_one_node_stops_all(driver: SteppedCan) -> None:
    mover = Mover(driver)
    mover.run(0.2)
    driver.front.arms[1].drives[3]._beat_due_s = np.inf
    said = trouble(driver, 4 * FILE.heartbeat_s + 2 * PERIOD, mover)
    assert "PSM2 roll (node 4) has lost its heartbeat" in said
    comes_to_rest(driver)


def test_a_node_that_falls_silent_is_found_by_its_unanswered_syncs(driver: SteppedCan) -> None:
    mover = Mover(driver)
    mover.run(0.2)
    driver.front.arms[0].drives[2].is_mute = True
    said = trouble(driver, 6 * PERIOD, mover)
    assert "PSM1 insertion (node 3) has not answered" in said
    comes_to_rest(driver)


@pytest.mark.parametrize(
    ("word", "frame"),
    [("is off", (0x40, bytes(8))), ("error-passive", (0x04, b"\0\x20\0\0\0\0\0\0"))],
)
def test_a_bus_that_is_off_or_error_passive_stops_all(
    driver: SteppedCan, word: str, frame: tuple[int, bytes]
) -> None:
    mover = Mover(driver)
    mover.run(0.2)
    bus = stranger(driver, 1)
    say(bus, *frame, is_error_frame=True)
    said = trouble(driver, 2 * PERIOD, mover)
    assert f"bus of PSM2 {word}" in said.replace(" is error", " error")
    comes_to_rest(driver)
    bus.shutdown()


@pytest.mark.parametrize("state", [can.BusState.ERROR, can.BusState.PASSIVE])
def test_what_the_controller_says_of_its_bus_counts(
    driver: SteppedCan, state: can.BusState, monkeypatch: pytest.MonkeyPatch
) -> None:
    mover = Mover(driver)
    monkeypatch.setattr(type(driver.masters[0].line._bus), "state", state)
    assert "bus of PSM1 is" in trouble(driver, 2 * PERIOD, mover)
    comes_to_rest(driver)


def test_a_bus_that_takes_no_frames_is_a_named_error_and_its_drives_stop(
    driver: SteppedCan, monkeypatch: pytest.MonkeyPatch
) -> None:
    mover = Mover(driver)
    mover.run(0.2)

    def refuse(*_: object) -> None:
        raise can.CanOperationError("no buffer space")

    monkeypatch.setattr(driver.masters[0].line._bus, "send", refuse)
    assert "bus of PSM1 takes no frame" in trouble(driver, 2 * PERIOD, mover)
    with contextlib.suppress(DriverError):
        driver.state()
    let_pass(driver, FILE.watchdog_s + 0.05)
    assert all(d.state is not Drive.OPERATION_ENABLED for d in driver.front.arms[0].drives)


@pytest.mark.parametrize("key", SAFETY_KEYS)
def test_an_object_that_does_not_keep_its_value_refuses_the_connection(
    driver: SteppedCan, key: str
) -> None:
    index, sub = int(key[2:6], 16), int(key[7:], 16)
    bad = driver.front.arms[1].drives[6]
    bad.deaf.add((index, sub))
    entry = bad.entries[index, sub]
    entry.value = {0x1400: 7, 0x1800: 7}.get(index, entry.value ^ 0x41)
    with pytest.raises(DriverError, match=rf"PSM2 jaw \(node 7\): object {key} .* reads"):
        driver.connect()
    with pytest.raises(DriverError, match="connect"):
        driver.enable()


def test_an_object_that_a_drive_lacks_refuses_the_connection(driver: SteppedCan) -> None:
    del driver.front.arms[0].drives[0].entries[0x6065, 0]
    with pytest.raises(DriverError, match=r"0x6065:00 .*is refused"):
        driver.connect()


def test_a_drive_that_does_not_answer_refuses_the_connection(driver: SteppedCan) -> None:
    driver.front.arms[0].drives[4].is_mute = True
    with pytest.raises(DriverError, match=r"PSM1 wrist_pitch \(node 5\) does not answer"):
        driver.connect()


def test_two_drives_with_one_node_id_refuse_the_connection(driver: SteppedCan) -> None:
    driver.front.arms[0].drives.append(SimulatedDrive(3))
    with pytest.raises(DriverError, match=r"node 3\) has answered twice"):
        driver.connect()


def test_a_second_drive_of_the_same_id_on_the_running_bus_stops_all(driver: SteppedCan) -> None:
    mover = Mover(driver)
    twin, bus = driver.front.arms[0].drives[2], stranger(driver)
    mover.run(0.1)
    data = struct.pack("<Hi", 0x237, twin.actual)
    for _ in range(2):  # one of them could be the answer that is due
        say(bus, 0x183, data)
    assert "answered one SYNC twice" in trouble(driver, 3 * PERIOD, mover)
    comes_to_rest(driver)
    bus.shutdown()


def test_a_following_error_stops_all_and_is_told_apart(driver: SteppedCan) -> None:
    mover = Mover(driver, speed=0.05)
    mover.run(0.2)
    drive = driver.front.arms[0].drives[0]
    drive.entries[0x6065, 0].value = 1
    said = trouble(driver, 0.1 + 4 * PERIOD, mover)
    assert "PSM1 yaw (node 1) reports emergency 0x8611 (following error)" in said
    comes_to_rest(driver)


@pytest.mark.parametrize("high", sorted(CLASSES))
def test_an_emergency_of_every_class_stops_all_and_is_named(driver: SteppedCan, high: int) -> None:
    mover = Mover(driver)
    code = high << 8 | 0x99
    driver.front.arms[1].drives[0].fail(code)
    said = trouble(driver, 3 * PERIOD, mover)
    assert f"PSM2 yaw (node 1) reports emergency 0x{code:04X} ({CLASSES[high]})" in said
    comes_to_rest(driver)
    driver.enable()  # a person has put it right
    assert {arm.operating_state for arm in wait(driver).arms} == {"ENABLED"}


@pytest.mark.parametrize(
    ("target", "code"), [(2**31 - 1, "0x8612"), (100_000, "0x8400")], ids=["range", "speed"]
)
def test_a_drive_refuses_a_target_out_of_range_or_too_far_away(
    driver: SteppedCan, target: int, code: str
) -> None:
    armed(driver)
    drive, axis = driver.front.arms[0].drives[0], driver.masters[0].axes[0]
    axis.target = target if target > 10**6 else drive.actual + target
    said = trouble(driver, 4 * PERIOD)
    assert code in said
    comes_to_rest(driver)


def test_another_master_on_the_bus_stops_all(driver: SteppedCan) -> None:
    mover = Mover(driver)
    bus = stranger(driver)
    say(bus, 0x201, struct.pack("<Hi", 0x0F, driver.front.arms[0].drives[0].actual))
    assert "somebody else commands (frame 0x201)" in trouble(driver, 2 * PERIOD, mover)
    comes_to_rest(driver)
    bus.shutdown()


def test_a_drive_that_is_stopped_or_restarts_by_itself_stops_all(driver: SteppedCan) -> None:
    mover = Mover(driver)
    bus = stranger(driver, 1)
    driver.front.arms[1].drives[5].hear_nmt(b"\x81\x06")
    assert "PSM2 wrist_yaw (node 6)" in trouble(driver, 3 * PERIOD, mover)
    comes_to_rest(driver)
    bus.shutdown()


def test_a_silent_input_node_is_no_consent_and_an_emergency_stop(driver: SteppedCan) -> None:
    armed(driver)
    driver.front.input_is_mute = True
    state = wait(driver, round(0.1 / PERIOD) + 2)
    assert state.inputs.estop
    assert not state.inputs.consent


def test_ten_thousand_random_frames_raise_nothing_and_move_nothing(driver: SteppedCan) -> None:
    armed(driver)
    rng = random.Random(0)
    buses = [stranger(driver, 0), stranger(driver, 1)]
    before = [arm.measured_jp for arm in driver.state().arms]
    named = 0
    for _ in range(1000):
        for _ in range(10):
            is_extended = rng.random() < 0.1
            say(
                rng.choice(buses),
                rng.randrange(1 << (29 if is_extended else 11)),
                rng.randbytes(rng.randrange(9)),
                is_extended_id=is_extended,
                is_remote_frame=rng.random() < 0.05,
                is_error_frame=rng.random() < 0.05,
            )
        driver.clock.sleep_until(driver.clock.now() + PERIOD)
        try:
            driver.state()
        except DriverError:
            named += 1
    assert named > 0
    after = [arm.measured_jp for arm in driver.side.truth().arms]
    np.testing.assert_allclose(after, before, atol=1e-3)
    assert not any(drive.state is Drive.OPERATION_ENABLED for drive in drives(driver))
    for bus in buses:
        bus.shutdown()


def test_truncated_answers_are_no_answers(driver: SteppedCan) -> None:
    mover = Mover(driver)
    drive = driver.front.arms[0].drives[1]
    whole = drive.take
    drive.take = lambda: [(i, data[:3]) for i, data in whole()]  # type: ignore[method-assign]
    assert "PSM1 pitch (node 2)" in trouble(driver, 6 * PERIOD, mover)
    assert driver.masters[0].axes[1].spoilt > 0
    comes_to_rest(driver)


def test_another_master_than_ours_can_use_the_drives(driver: SteppedCan) -> None:
    """canopen's own master, its SDO client and its threads, on the simulated drives."""
    channel = driver.front.lines[0]._bus.channel_id
    network = canopen.Network()
    network.connect(interface="virtual", channel=channel)
    node = network.add_node(1, canopen.ObjectDictionary())
    try:
        done: list[bytes] = []

        def ask() -> None:
            done.append(node.sdo.upload(0x1000, 0))
            node.sdo.download(0x1017, 0, b"\x64\x00")
            done.append(node.sdo.upload(0x1017, 0))
            with pytest.raises(canopen.SdoAbortedError):
                node.sdo.upload(0x2000, 0)
            done.append(b"end")

        worker = threading.Thread(target=ask)
        let_pass(driver, PERIOD)  # the drives boot
        worker.start()
        for _ in range(2000):
            let_pass(driver, PERIOD)
            worker.join(0.001)
            if not worker.is_alive():
                break
        assert done == [b"\x92\x01\x02\x00", b"\x64\x00", b"end"]
    finally:
        network.disconnect()


def test_the_load_of_the_buses_is_known_and_too_fast_a_period_is_refused() -> None:
    driver = SteppedCan(CELL, FILE)
    assert 0.4 < driver.load["PSM1"] < 0.45
    driver.close()
    with pytest.raises(DriverError, match="84"):
        SteppedCan(CELL, FILE, WorldOptions(period_s=0.002))
