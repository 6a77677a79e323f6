"""The CRTK driver against scripted dVRK arms, on a fake clock."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import pytest
from scripted_arms import PLACE, Room, stamped

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import PSM_JOINTS, CellState, JointSetpoint
from viskill_deploy.drivers.crtk.driver import CrtkDriver, CrtkOptions
from viskill_deploy.drivers.crtk.messages import Header, JointState, Joy, String, Time
from viskill_deploy.drivers.watch import OwnTime
from viskill_deploy.safety.checked import _TOKEN, CheckedSetpoint

CELL = load_cell("bipegtransfer")
REST = (0.0,) * 6


def driver_in(room: Room) -> CrtkDriver:
    made = CrtkDriver(CELL, room.node, CrtkOptions(), OwnTime)
    made.clock = room.clock
    return made


@pytest.fixture
def room() -> Room:
    return Room()


@pytest.fixture
def driver(room: Room) -> Iterator[CrtkDriver]:
    made = driver_in(room)
    made.connect()
    yield made
    made.close()


def ready(driver: CrtkDriver) -> None:
    driver.enable()
    driver.home()


def setpoints(
    yaw: float = PLACE[0], jaw: float = 0.2, speed: float = 0.0
) -> tuple[CheckedSetpoint, ...]:
    wish = JointSetpoint((yaw, *PLACE[1:]), (speed, *REST[1:]), jaw, -speed)
    return tuple(CheckedSetpoint(arm, wish, _TOKEN) for arm in range(2))


def cycle(driver: CrtkDriver, wish: Sequence[CheckedSetpoint]) -> CellState:
    """One cycle of a runtime."""
    state = driver.state()
    driver.servo_jp(wish)
    driver.clock.sleep_until(driver.clock.now() + driver.period_s)
    return state


def stream(driver: CrtkDriver, seconds: float = 0.1) -> None:
    for _ in range(round(seconds / driver.period_s)):
        cycle(driver, setpoints())


def wait(driver: CrtkDriver, seconds: float) -> CellState:
    driver.clock.sleep_until(driver.clock.now() + seconds)
    return driver.state()


def refusal(call: Callable[[], object]) -> str:
    with pytest.raises(DriverError) as caught:
        call()
    return str(caught.value)


def test_connecting_commands_nothing_and_leaves_the_arms_disabled(room: Room, driver: CrtkDriver):
    wait(driver, 1.0)
    assert [arm.operating_state for arm in driver.state().arms] == ["DISABLED", "DISABLED"]
    driver.close()
    for arm in room.arms:
        assert (arm.words, arm.holds, arm.sent) == ([], [], [])


def test_an_arm_that_is_not_heard_is_named_with_its_topic_and_the_transport(room: Room):
    room.arms[1].node.close()
    room.clock.peers = room.arms[:1]
    driver = driver_in(room)
    said = refusal(driver.connect)
    assert "/PSM2/operating_state over inproc" in said
    assert room.clock.now() == pytest.approx(110.0, abs=0.1)
    assert "connect" in refusal(driver.state)


def test_a_homed_arm_whose_joints_are_silent_is_not_connected(room: Room):
    room.arms[0].become("ENABLED", is_homed=True)
    room.arms[0].is_silent = True
    assert "/PSM1/measured_js over inproc" in refusal(driver_in(room).connect)


def test_an_arm_without_power_may_be_silent_and_is_not_vouched_for(room: Room):
    """As dVRK 2.2 and 2.3; 2.4 sends stamps of zero instead."""
    room.arms[0].is_silent = True
    driver = driver_in(room)
    driver.connect()
    assert [arm.valid for arm in wait(driver, 0.1).arms] == [False, True]
    driver.close()


def test_other_joints_than_the_cells_are_refused_at_the_connection(room: Room):
    room.arms[1].spoil = lambda topic, message: replace(
        message, name=PSM_JOINTS[::-1][: len(message.name)]
    )
    assert "/PSM2/measured_js carries the joints wrist_yaw" in refusal(driver_in(room).connect)


def test_enable_and_home_wait_for_the_arms(room: Room, driver: CrtkDriver):
    driver.enable()
    assert [arm.operating_state for arm in driver.state().arms] == ["ENABLED", "ENABLED"]
    assert not any(arm.is_homed for arm in driver.state().arms)
    driver.home()
    assert all(arm.is_homed for arm in driver.state().arms)
    assert [arm.words for arm in room.arms] == [["enable", "home"]] * 2


def test_an_arm_that_is_enabled_and_homed_is_told_nothing(room: Room, driver: CrtkDriver):
    ready(driver)
    ready(driver)
    assert [arm.words for arm in room.arms] == [["enable", "home"]] * 2


def test_a_paused_arm_is_resumed(room: Room, driver: CrtkDriver):
    room.arms[0].become("PAUSED", is_homed=True)
    ready(driver)
    assert room.arms[0].words == ["resume"]


def test_a_state_command_is_said_again_every_half_second_until_it_has_an_effect(
    room: Room, driver: CrtkDriver
):
    deaf = room.arms[1]
    deaf.is_obedient = False
    began = room.clock.now()
    said = refusal(driver.enable)
    times = [now - began for now, word in deaf.heard if word == "enable"]
    assert len(times) == 30
    assert times[:4] == pytest.approx([0.0, 0.5, 1.0, 1.5], abs=0.02)
    assert 'PSM2 is DISABLED and does not follow "enable" within 15 s' in said
    assert room.arms[0].words == ["enable"]
    assert room.arms[0].sent == room.arms[1].sent == []


def test_an_arm_that_is_busy_with_a_command_is_not_told_again(room: Room, driver: CrtkDriver):
    slow = room.arms[0]
    slow.is_obedient = False
    slow.is_busy = True
    slow.tell()
    refusal(driver.enable)
    assert slow.words == []


def test_homing_a_disabled_arm_is_refused(driver: CrtkDriver):
    assert "enable" in refusal(driver.home)


def test_an_older_operating_state_is_ignored(room: Room, driver: CrtkDriver):
    ready(driver)
    arm = room.arms[0]
    old = Header(Time.of_ns(room.node.stamp_ns() - 5_000_000_000))
    arm.state = "FAULT"
    arm.tell(old)
    assert driver.state().arms[0].operating_state == "ENABLED"
    arm.tell()
    assert driver.state().arms[0].operating_state == "FAULT"


def test_a_robot_whose_clock_is_set_back_is_heard_all_the_same(room: Room, driver: CrtkDriver):
    ready(driver)
    for arm in room.arms:
        arm.skew_ns = -3_600_000_000_000
    state = wait(driver, 0.05)
    assert all(abs(driver.clock.now() - arm.stamp_s) < 0.011 for arm in state.arms)
    room.arms[0].become("FAULT")
    assert driver.state().arms[0].operating_state == "FAULT"


def test_the_age_of_feedback_does_not_depend_on_the_robots_clock(room: Room, driver: CrtkDriver):
    for arm, skew in zip(room.arms, (3_600, -7), strict=True):
        arm.skew_ns = skew * 1_000_000_000
    state = wait(driver, 0.5)
    for arm in state.arms:
        assert 0.0 <= driver.clock.now() - arm.stamp_s < 0.011
    for peer in room.arms:
        peer.is_silent = True
    state = wait(driver, 0.2)
    for arm in state.arms:
        assert driver.clock.now() - arm.stamp_s == pytest.approx(0.2, abs=0.011)


@pytest.mark.parametrize(
    "topic", ["measured_js", "setpoint_js", "jaw/measured_js", "jaw/setpoint_js"]
)
def test_the_age_of_an_arm_is_that_of_its_oldest_topic(room: Room, driver: CrtkDriver, topic: str):
    arm, old = room.arms[0], room.node.stamp_ns()
    arm.spoil = lambda name, message: stamped(message, old) if name == topic else message
    state = wait(driver, 0.2)
    ages = [driver.clock.now() - arm.stamp_s for arm in state.arms]
    assert ages[0] == pytest.approx(0.2, abs=0.021)
    assert ages[1] < 0.011


@pytest.mark.parametrize(
    "topic", ["measured_js", "setpoint_js", "jaw/measured_js", "jaw/setpoint_js"]
)
def test_a_stamp_of_zero_makes_an_arm_invalid(room: Room, driver: CrtkDriver, topic: str):
    arm = room.arms[0]
    arm.spoil = lambda name, message: stamped(message, 0) if name == topic else message
    assert [arm.valid for arm in wait(driver, 0.02).arms] == [False, True]
    arm.spoil = lambda name, message: message
    assert [arm.valid for arm in wait(driver, 0.02).arms] == [True, True]


def test_a_measurement_that_is_no_number_is_handed_to_the_gate(room: Room, driver: CrtkDriver):
    arm = room.arms[1]
    arm.jp = (math.nan, *PLACE[1:])
    state = wait(driver, 0.02)
    assert math.isnan(state.arms[1].measured_jp[0])
    assert not state.arms[1].valid


def test_a_malformed_measurement_is_an_error_that_names_the_topic(room: Room, driver: CrtkDriver):
    room.arms[1].spoil = lambda name, m: (
        replace(m, position=m.position[:5]) if len(m.name) == 6 else m
    )
    assert "/PSM2/measured_js carries 5 positions" in refusal(lambda: wait(driver, 0.02))


def test_setpoints_are_refused_before_the_arms_are_enabled_and_homed(
    room: Room, driver: CrtkDriver
):
    assert "not ready (PSM1 DISABLED, PSM2 DISABLED)" in refusal(
        lambda: driver.servo_jp(setpoints())
    )
    for arm in room.arms:
        arm.become("ENABLED", is_homed=True)  # by somebody else
    assert "not ready" in refusal(lambda: driver.servo_jp(setpoints()))
    driver.enable()
    assert "not ready" in refusal(lambda: driver.servo_jp(setpoints()))
    driver.home()
    driver.servo_jp(setpoints())
    assert [len(arm.sent) for arm in room.arms] == [1, 1]


def test_joints_and_jaw_go_out_together_with_names_stamp_position_and_velocity(
    room: Room, driver: CrtkDriver
):
    ready(driver)
    driver.servo_jp(setpoints(0.1000001, 0.3, 0.25))
    head = Header(Time.of_ns(room.node.stamp_ns()))
    for arm in room.arms:
        joints = JointState(head, PSM_JOINTS, (0.1000001, *PLACE[1:]), (0.25, *REST[1:]))
        assert arm.sent == [joints]
        assert arm.sent_jaw == [JointState(head, ("jaw",), (0.3,), (-0.25,))]
    driver.servo_jp(setpoints())
    assert room.arms[0].sent[-1].velocity == REST


def test_nothing_goes_out_when_one_arm_is_not_ready(room: Room, driver: CrtkDriver):
    ready(driver)
    room.arms[1].become("PAUSED", is_homed=True)
    assert "not ready (PSM2 PAUSED)" in refusal(lambda: driver.servo_jp(setpoints()))
    assert room.arms[0].sent == []


def test_no_setpoint_is_ever_sent_twice(room: Room, driver: CrtkDriver):
    ready(driver)
    driver.servo_jp(setpoints())
    wait(driver, 5.0)
    assert [len(arm.sent) for arm in room.arms] == [1, 1]
    assert [len(arm.sent_jaw) for arm in room.arms] == [1, 1]


@pytest.mark.parametrize("topic", ["/MTMR_PSM1/following", "/MTML_PSM1/following"])
def test_an_arm_that_a_teleoperation_commands_is_not_enabled(
    room: Room, driver: CrtkDriver, topic: str
):
    follow = room.teleoperate(topic)
    follow(True)
    assert f"a teleoperation commands PSM1 ({topic})" in refusal(driver.enable)
    assert room.arms[0].words == []
    driver.state()  # one may look
    follow(False)
    ready(driver)


def test_a_teleoperation_that_takes_an_arm_ends_the_stream_and_both_arms_hold(
    room: Room, driver: CrtkDriver
):
    follow = room.teleoperate("/MTMR_PSM1/following")
    ready(driver)
    stream(driver)
    follow(True)
    before = [len(arm.sent) for arm in room.arms]
    assert "a teleoperation commands PSM1" in refusal(lambda: cycle(driver, setpoints()))
    follow(False)
    assert "a teleoperation commands PSM1" in refusal(lambda: driver.servo_jp(setpoints()))
    assert [len(arm.sent) for arm in room.arms] == before
    assert [len(arm.holds) for arm in room.arms] == [1, 1]
    ready(driver)  # somebody starts again
    driver.servo_jp(setpoints())


@pytest.mark.parametrize("topic", ["IO/arm_clutch", "manip_clutch"])
def test_a_pressed_clutch_ends_the_stream(room: Room, driver: CrtkDriver, topic: str):
    ready(driver)
    stream(driver)
    room.arms[1].say(topic, Joy(buttons=(1,)))
    assert "somebody presses PSM2's clutch" in refusal(driver.state)
    assert [len(arm.holds) for arm in room.arms] == [1, 1]
    assert "presses PSM2's clutch" in refusal(driver.enable)
    room.arms[1].say(topic, Joy(buttons=(0,)))
    driver.enable()


@pytest.mark.parametrize(
    ("tool", "why"),
    [
        ("DEBAKEY_FORCEPS:400036", "PSM1 has debakey_forceps_400036 and not large_needle"),
        ("", "PSM1 has no instrument and not large_needle_driver_400006"),
        ("ERROR", "PSM1 has error and not"),
    ],
)
def test_another_instrument_ends_the_stream_and_is_not_homed(
    room: Room, driver: CrtkDriver, tool: str, why: str
):
    ready(driver)
    stream(driver)
    room.arms[0].say("tool_type", String(tool))
    assert why in refusal(lambda: cycle(driver, setpoints()))
    driver.enable()
    assert why in refusal(driver.home)
    room.arms[0].say("tool_type", String("LARGE_NEEDLE_DRIVER:400006"))
    ready(driver)
    assert driver.state().arms[0].tool == "large_needle_driver_400006"


def test_an_arm_that_does_not_say_what_instrument_it_has_is_not_homed(room: Room):
    room.exchange.lines["/PSM2/tool_type"].latched = None
    driver = driver_in(room)
    driver.connect()
    driver.enable()
    assert "/PSM2/tool_type is silent" in refusal(driver.home)
    assert driver.state().arms[1].tool == ""
    driver.close()


def test_an_arm_that_is_busy_with_something_else_ends_the_stream(room: Room, driver: CrtkDriver):
    ready(driver)
    stream(driver)
    room.arms[1].become("ENABLED", is_homed=True, is_busy=True)
    assert "PSM2 is busy with a motion of somebody else" in refusal(driver.state)


@pytest.mark.parametrize("joint", range(7))
def test_a_setpoint_that_was_not_sent_from_here_ends_the_stream(
    room: Room, driver: CrtkDriver, joint: int
):
    ready(driver)
    stream(driver)
    arm = room.arms[0]
    far = [0.0055, 0.0055, 0.00055, 0.0055, 0.0055, 0.0055, 0.021][joint]
    if joint == 6:
        arm.jaw += far
    else:
        arm.jp = (*arm.jp[:joint], arm.jp[joint] + far, *arm.jp[joint + 1 :])
    arm.speak()
    name = (*PSM_JOINTS, "jaw")[joint]
    assert f"PSM1 holds a setpoint for {name} that was not sent" in refusal(driver.state)
    assert [len(peer.holds) for peer in room.arms] == [1, 1]


def test_a_setpoint_between_two_that_were_sent_is_ours(room: Room, driver: CrtkDriver):
    ready(driver)
    for step in range(40):
        cycle(driver, setpoints(PLACE[0] + 0.02 * step, 0.2 + 0.05 * step))
        for arm in room.arms:  # it interpolates, and is behind
            ahead = step - 7.5
            arm.jp = (PLACE[0] + 0.02 * max(ahead, 0.0), *PLACE[1:])
            arm.jaw = 0.2 + 0.05 * max(ahead, 0.0)


def test_an_arm_that_falls_silent_while_it_moves_is_silent_and_nobody_elses(
    room: Room, driver: CrtkDriver
):
    ready(driver)
    stream(driver)
    room.arms[0].is_silent = True
    for step in range(95):  # half a second less than one feedback
        cycle(driver, setpoints(PLACE[0] + 0.002 * step))
    assert "/PSM1/measured_js is silent" in refusal(
        lambda: [cycle(driver, setpoints(0.3)) for _ in range(20)]
    )


def test_arms_that_were_moved_while_nothing_was_sent_begin_another_stream(
    room: Room, driver: CrtkDriver
):
    ready(driver)
    stream(driver)
    wait(driver, 0.3)
    for arm in room.arms:
        arm.jp = (0.4, *PLACE[1:])
    wait(driver, 0.02)
    for _ in range(40):
        cycle(driver, setpoints(0.4))


def test_an_error_that_an_arm_reports_while_it_is_sent_setpoints_needs_a_person(
    room: Room, driver: CrtkDriver
):
    room.arms[0].say("error", String("something of long ago"))
    ready(driver)
    stream(driver)
    room.arms[1].say("error", String("PSM2: something is wrong"))
    said = refusal(lambda: cycle(driver, setpoints()))
    assert "PSM2: something is wrong" in said
    assert "a person has to look" in said
    assert [len(peer.holds) for peer in room.arms] == [1, 1]
    assert "a person has to look" in refusal(driver.enable)


def test_a_fault_stays_until_a_person_says_that_it_is_over(room: Room, driver: CrtkDriver):
    ready(driver)
    stream(driver)
    arm = room.arms[0]
    arm.say("error", String("PSM1_PID: tracking error, mask 1"))
    arm.become("FAULT")
    assert driver.state().arms[0].operating_state == "FAULT"  # for the gate to see
    said = refusal(lambda: driver.servo_jp(setpoints()))
    assert "PSM1 is in FAULT (PSM1_PID: tracking error, mask 1)" in said
    assert [len(peer.holds) for peer in room.arms] == [1, 1]
    arm.become("DISABLED")  # somebody has reset it elsewhere: a person of ours has not looked
    assert "a person has to look" in refusal(driver.enable)
    assert arm.words == ["enable", "home"]
    driver.recover()
    ready(driver)
    driver.servo_jp(setpoints())
    assert arm.words == ["enable", "home", "enable", "home"]
    assert room.arms[1].words == ["enable", "home", "disable", "enable", "home"]


def test_who_closes_takes_power_and_leaves_a_fault_for_a_person_to_clear(
    room: Room, driver: CrtkDriver
):
    ready(driver)
    stream(driver)
    room.arms[0].become("FAULT")
    driver.state()
    driver.disable()
    wait(driver, 0.1)
    driver.close()
    assert [arm.state for arm in room.arms] == ["FAULT", "DISABLED"]
    assert "disable" not in room.arms[0].words


def test_out_of_fault_leads_disable_then_enable_then_home(room: Room):
    room.arms[0].become("FAULT")
    driver = driver_in(room)
    driver.connect()
    assert "PSM1 is in FAULT (without a word on why)" in refusal(driver.enable)
    driver.recover()
    ready(driver)
    assert room.arms[0].words == ["disable", "enable", "home"]
    driver.close()


def test_power_loss_is_an_emergency_stop(room: Room, driver: CrtkDriver):
    ready(driver)
    assert driver.state().inputs.estop is False
    room.arms[1].say("error", String("PSM2: detected power loss (actuators / brakes)"))
    room.arms[1].become("FAULT")
    assert driver.state().inputs.estop is True


def test_a_topic_that_is_silent_for_half_a_second_ends_the_stream(room: Room, driver: CrtkDriver):
    ready(driver)
    stream(driver)
    room.arms[1].is_silent = True
    began = room.clock.now()
    said = refusal(lambda: stream(driver, 1.0))
    assert "/PSM2/measured_js is silent" in said
    assert room.clock.now() - began == pytest.approx(0.5, abs=0.02)
    driver.close()
    assert [arm.words[-2:] for arm in room.arms] == [["pause", "disable"]] * 2


def test_hold_is_published_to_every_arm(room: Room, driver: CrtkDriver):
    driver.hold()
    assert [len(arm.holds) for arm in room.arms] == [1, 1]


def test_disable_is_said_until_the_arms_are_off(room: Room, driver: CrtkDriver):
    ready(driver)
    room.arms[0].is_obedient = False
    driver.disable()
    assert "not ready" in refusal(lambda: driver.servo_jp(setpoints()))
    for _ in range(300):
        wait(driver, 0.004)
    assert room.arms[0].words.count("disable") == 3
    assert room.arms[1].words.count("disable") == 1
    room.arms[0].become("DISABLED")
    wait(driver, 2.0)
    assert room.arms[0].words.count("disable") == 3


def test_closing_holds_and_disables_and_may_be_done_twice(room: Room, driver: CrtkDriver):
    ready(driver)
    driver.close()
    driver.close()
    for arm in room.arms:
        assert len(arm.holds) == 1
        assert arm.words == ["enable", "home", "disable"]
    assert "connect" in refusal(driver.hold)
    assert "connect" in refusal(lambda: driver.watch)


def test_consent_is_the_pedal_and_only_while_it_is_pressed(room: Room, driver: CrtkDriver):
    assert not driver.state().inputs.consent
    for button, agrees in ((1, True), (0, False), (1, True), (2, False)):
        room.present(button)
        inputs = wait(driver, 0.02).inputs
        assert inputs.consent is agrees
        assert inputs.consent_source == "operator_present"
        assert not inputs.consent_is_streamed
        assert inputs.consent_stamp_s == pytest.approx(driver.clock.now() - 0.02)


def test_the_pedal_of_the_named_console_counts_and_no_other(room: Room):
    driver = CrtkDriver(CELL, room.node, CrtkOptions(console="console2"), OwnTime)
    driver.clock = room.clock
    driver.connect()
    room.present(1)
    assert not wait(driver, 0.02).inputs.consent
    second = room.console.publisher("/console2/operator_present", Joy, True)
    second(Joy(Header(Time.of_ns(room.node.stamp_ns())), (), (1,)))
    assert wait(driver, 0.02).inputs.consent
    driver.close()


def test_consent_lives_while_arms_and_console_are_there(room: Room, driver: CrtkDriver):
    room.present(1)
    state = wait(driver, 0.5)
    assert state.inputs.consent_alive_s == min(arm.stamp_s for arm in state.arms)
    room.console.close()
    inputs = driver.state().inputs
    assert not inputs.consent
    assert inputs.consent_alive_s == -math.inf


def test_a_real_cell_has_no_simulated_operator_and_no_objects(driver: CrtkDriver):
    assert driver.scene() is None
    assert not driver.capabilities.simulated
    for call in (driver.say, driver.active_object, lambda: driver.break_drive("PSM1/yaw", "stuck")):
        with pytest.raises(DriverError):
            call()
    with pytest.raises(DriverError, match="by hand"):
        driver.reset(None)  # type: ignore[arg-type]
