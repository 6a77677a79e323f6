"""What every driver must do. A new driver adds itself to `DRIVERS` and passes the same tests."""

import dataclasses
import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import served_arms

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import DriverError, SafetyStop
from viskill_deploy.core.types import PSM_JOINTS, Action, CellState, JointSetpoint, Request
from viskill_deploy.drivers import loopback, loopback_served
from viskill_deploy.drivers.base import DISABLED, ENABLED, Driver
from viskill_deploy.drivers.can import simulated as can
from viskill_deploy.drivers.can.config import load_can
from viskill_deploy.drivers.crtk import simulated as crtk
from viskill_deploy.safety.checked import CheckedSetpoint
from viskill_deploy.safety.supervisor import Supervisor
from viskill_deploy.sim.tasks.base import load_task
from viskill_deploy.sim.world import WorldOptions

pytestmark = pytest.mark.no_cover

CELL = load_cell("bipegtransfer")


def served_can() -> Driver:
    """Over `udp_multicast`, with time for heartbeats on a machine that runs other tests as well."""
    file = can.on_own_groups(load_can("bipegtransfer", CELL))
    slow = file.model_copy(update={"heartbeat_s": 0.3})
    made = can.ServedCan(CELL, slow, WorldOptions(period_s=0.01))
    made.connect()
    return made


DRIVERS: dict[str, Callable[[], Driver]] = {
    "loopback": lambda: loopback.connect(CELL),
    "CAN, stepped": lambda: can.connect(CELL),
    "CRTK, stepped": lambda: crtk.connect(CELL),
    "CRTK over DDS": lambda: served_arms.connected("dds"),
    "CAN, served": served_can,
    "served loopback": lambda: loopback_served.connect(CELL, WorldOptions(period_s=0.01)),
}
SETTLE = 30


@pytest.fixture(params=DRIVERS, ids=lambda name: name.replace(" ", "-"))
def driver(request: pytest.FixtureRequest) -> Iterator[Driver]:
    made = DRIVERS[request.param]()
    made.reset(load_task("bipegtransfer").sample_layout(np.random.default_rng(0), "reference"))
    yield made
    made.close()


def wait(driver: Driver, periods: int = 1) -> CellState:
    driver.clock.sleep_until(driver.clock.now() + periods * driver.period_s)
    return driver.state()


def await_state(driver: Driver, wish: Callable[[CellState], bool]) -> CellState:
    for _ in range(SETTLE):
        state = wait(driver)
        if wish(state):
            return state
    raise AssertionError("the driver never reached the awaited state")


def armed(driver: Driver) -> Supervisor:
    driver.enable()
    driver.home()
    driver.say(consent=False)
    gate = Supervisor(CELL, driver.period_s)
    gate.connect(await_state(driver, lambda s: s.arms[0].is_homed and not s.inputs.consent))
    driver.say(consent=True)
    state = await_state(driver, lambda s: s.inputs.consent)
    assert gate.arm(state, driver.clock.now()) == ()
    return gate


def staying(state: CellState) -> tuple[JointSetpoint, ...]:
    return tuple(
        JointSetpoint(a.setpoint_jp, (0.0,) * 6, a.jaw_setpoint_jp, 0.0) for a in state.arms
    )


def checked(driver: Driver, gate: Supervisor, setpoints: tuple[JointSetpoint, ...]) -> tuple:
    decision = gate.check(driver.state(), Request(setpoints), driver.clock.now())
    assert decision.action < Action.HOLD, decision.verdicts
    return decision.setpoints


def test_states_are_complete_finite_and_young(driver: Driver) -> None:
    for _ in range(3):
        state = wait(driver)
        assert [arm.name for arm in state.arms] == [arm.name for arm in CELL.arms]
        for arm in state.arms:
            assert arm.valid
            assert arm.joint_names == PSM_JOINTS
            assert arm.tool == "large_needle_driver_400006"
            numbers = (*arm.measured_jp, *arm.measured_jv, *arm.setpoint_jp, arm.jaw_measured_jp)
            assert len(numbers) == 19
            assert all(type(x) is float and math.isfinite(x) for x in numbers)
            assert 0.0 <= driver.clock.now() - arm.stamp_s < 0.1


def test_arms_start_disabled_and_become_enabled_then_homed(driver: Driver) -> None:
    assert {arm.operating_state for arm in driver.state().arms} == {DISABLED}
    driver.enable()
    state = await_state(driver, lambda s: s.arms[0].operating_state == ENABLED)
    assert not any(arm.is_homed for arm in state.arms)
    driver.home()
    await_state(driver, lambda s: all(arm.is_homed for arm in s.arms))


def test_homing_a_disabled_arm_is_refused(driver: Driver) -> None:
    with pytest.raises(DriverError, match="enable"):
        driver.home()


def test_plain_setpoints_are_refused(driver: Driver) -> None:
    armed(driver)
    with pytest.raises(DriverError, match="CheckedSetpoint"):
        driver.servo_jp(staying(driver.state()))  # type: ignore[arg-type]


def test_nobody_but_the_supervisor_can_make_a_setpoint_for_a_driver(driver: Driver) -> None:
    with pytest.raises(SafetyStop):
        CheckedSetpoint(0, staying(driver.state())[0])


def test_the_driver_takes_one_setpoint_an_arm_in_order(driver: Driver) -> None:
    gate = armed(driver)
    passed = checked(driver, gate, staying(driver.state()))
    with pytest.raises(DriverError):
        driver.servo_jp(passed[:1])
        await_state(driver, lambda s: False)
    with pytest.raises(DriverError):
        driver.servo_jp(tuple(reversed(passed)))


def test_a_passed_setpoint_reaches_the_arm_bit_for_bit(driver: Driver) -> None:
    gate = armed(driver)
    wish = tuple(
        dataclasses.replace(s, jp=(s.jp[0] + 1e-5, *s.jp[1:])) for s in staying(driver.state())
    )
    driver.servo_jp(checked(driver, gate, wish))
    sent = [(s.jp, s.jaw) for s in wish]  # an arm's echo may come a sample after the other's
    await_state(driver, lambda s: [(a.setpoint_jp, a.jaw_setpoint_jp) for a in s.arms] == sent)


def test_arms_hold_the_last_setpoint_when_the_stream_ends(driver: Driver) -> None:
    gate = armed(driver)
    passed = checked(driver, gate, staying(driver.state()))
    driver.servo_jp(passed)
    state = wait(driver, 40)
    for arm, sent in zip(state.arms, passed, strict=True):
        assert arm.setpoint_jp == sent.setpoint.jp
        np.testing.assert_allclose(arm.measured_jp, sent.setpoint.jp, atol=2e-4)
        assert max(map(abs, arm.measured_jv)) < 1e-2


def test_a_disabled_arm_takes_no_setpoint(driver: Driver) -> None:
    gate = armed(driver)
    passed = checked(driver, gate, staying(driver.state()))
    driver.disable()
    await_state(driver, lambda s: s.arms[0].operating_state == DISABLED)
    with pytest.raises(DriverError, match="not ready"):
        driver.servo_jp(passed)
        await_state(driver, lambda s: False)


def test_the_operator_and_the_emergency_stop_are_inputs(driver: Driver) -> None:
    driver.say(consent=True)
    state = await_state(driver, lambda s: s.inputs.consent)
    assert state.inputs.consent_source == "simulated"
    assert not state.inputs.estop
    driver.enable()  # some arms miss their power only when they have it
    driver.say(estop=True)
    await_state(driver, lambda s: s.inputs.estop)


def test_the_scene_names_the_active_object_and_its_goal(driver: Driver) -> None:
    wait(driver, 10)
    scene = driver.scene()
    assert scene is not None
    assert scene.active in {thing.name for thing in scene.objects}
    truth = driver.active_object()
    np.testing.assert_allclose(scene.pose(scene.active), truth.T_task_object, atol=1e-6)


def test_a_closed_driver_says_that_it_is_not_connected(driver: Driver) -> None:
    driver.close()
    driver.close()
    with pytest.raises(DriverError, match="connect"):
        driver.state()
