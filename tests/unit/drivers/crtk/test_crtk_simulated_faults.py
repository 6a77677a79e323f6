"""What goes wrong with a simulated dVRK, by itself and on demand, and how it is mended."""

from __future__ import annotations

import math
from typing import get_args

import pytest
from crtk_rig import PERIOD_S, Client, Rig

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.crtk.faults import Fault
from viskill_deploy.drivers.crtk.inproc import Inproc
from viskill_deploy.drivers.crtk.instruments import tool_type
from viskill_deploy.drivers.crtk.messages import Bool, Joy, String
from viskill_deploy.drivers.crtk.server_options import ServerOptions
from viskill_deploy.drivers.crtk.tracking import TOLERANCES, TrackingCheck


@pytest.fixture
def rig() -> Rig:
    return ready()


def ready(version: str = "2.4") -> Rig:
    rig = Rig(ServerOptions(version=version, homing="stay"))  # type: ignore[arg-type]
    rig.make_ready()
    rig.run(0.1)
    rig.client.forget()
    return rig


def recovers(rig: Rig) -> bool:
    """Whether disable, enable and home bring the arm back, to where it stands."""
    where = rig.measured()
    rig.client.command("disable")
    rig.until_idle()
    rig.make_ready()
    rig.run(0.2)
    return rig.measured() == pytest.approx(where, abs=0.02)


@pytest.mark.parametrize(
    ("version", "step", "is_fault"),
    [("2.4", 0.49, False), ("2.4", 0.51, True), ("2.3", 0.34, False), ("2.3", 0.36, True)],
)
def test_a_step_beyond_the_tracking_tolerance_is_a_fault_and_a_smaller_one_is_not(
    version: str, step: float, is_fault: bool
) -> None:
    rig = ready(version)
    q = rig.server.arms["PSM1"].arm.motion.setpoint.jp
    rig.client.joints("servo_jp", q[0] - step, *q[1:])
    rig.run(0.02)
    assert (rig.client.state.state == "FAULT") == is_fault
    if is_fault:
        assert rig.client.texts("error") == ["PSM1: tracking error, mask [1, 0, 0, 0, 0, 0, 0]"]
        rig.run(0.3)
        assert rig.measured()[0] == pytest.approx(q[0], abs=0.05)  # the brakes have caught it
        assert recovers(rig)


def test_a_joint_that_is_stuck_becomes_a_tracking_fault(rig: Rig) -> None:
    rig.cell.break_drive("PSM1/yaw", "stuck")
    q = rig.server.arms["PSM1"].arm.motion.setpoint.jp
    rig.client.joints("move_jp", q[0] - 0.8, *q[1:])
    rig.run(2.0)
    assert rig.client.summary == ("FAULT", False, False)
    assert rig.client.last("goal_reached").data is False


def test_tolerances_are_of_actuators_where_roll_wrist_and_jaw_are_coupled() -> None:
    arm = load_cell("bipegtransfer").arms[0].arm
    for version, tolerances in TOLERANCES.items():
        check = TrackingCheck(arm, version)
        for actuator, tolerance in enumerate(tolerances):
            for factor, is_far in ((0.99, False), (1.01, True)):
                joints = [0.0] * 7
                if actuator < 3:
                    joints[actuator] = factor * tolerance
                else:
                    column = arm.actuator_to_joint[:, actuator - 3]
                    joints[3:] = (factor * tolerance * column).tolist()
                mask = check.too_far(joints, [0.0] * 7)
                assert mask == (tuple(i == actuator for i in range(7)) if is_far else ())
        assert check.too_far([math.nan] * 7, [0.0] * 7)


def test_the_emergency_stop_takes_power_from_every_arm_until_it_is_released(rig: Rig) -> None:
    other = Client(rig.exchange, "PSM2")
    rig.make_ready(other)
    rig.cell.say(estop=True)
    rig.run(PERIOD_S)
    for client in (rig.client, other):
        assert client.summary == ("FAULT", False, False)
        assert "detected power loss (actuators / brakes)" in client.texts("error")[-1]
    rig.client.command("disable")
    rig.client.command("enable")
    rig.run(5.0)
    assert rig.client.summary == ("DISABLED", False, True)
    rig.run(1.5)
    assert rig.client.summary == ("FAULT", False, False)
    assert rig.client.texts("error")[-1] == "PSM1: failed to enable power"
    rig.cell.say(estop=False)
    assert recovers(rig)


def test_one_arm_can_lose_its_power(rig: Rig) -> None:
    other = Client(rig.exchange, "PSM2")
    rig.make_ready(other)
    rig.server.cause("power", "PSM1", True)
    rig.run(0.02)
    assert rig.client.state.state == "FAULT"
    assert other.state.state == "ENABLED"
    rig.server.cause("power", "PSM1", False)
    assert recovers(rig)


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("tracking", "tracking error"),
        ("potentiometers", "inconsistency between encoders and potentiometers"),
        ("current", "too many consecutive current safety violations"),
        ("amplifiers", "an amplifier is disabled or too hot"),
        ("watchdog", "watchdog triggered"),
    ],
)
def test_a_fault_that_takes_the_power_can_be_caused(rig: Rig, fault: str, said: str) -> None:
    rig.server.cause(fault, "PSM1", True)
    rig.run(PERIOD_S)
    assert rig.client.summary == ("FAULT", False, False)
    assert said in rig.client.texts("error")[0]
    assert recovers(rig)


def test_an_arm_can_fall_silent_while_its_states_go_on(rig: Rig) -> None:
    rig.server.cause("silence", "PSM1", True)
    rig.run(0.5)
    assert rig.client.all("measured_js") == rig.client.all("setpoint_js") == []
    assert rig.client.all("operating_state")
    rig.server.cause("silence", "PSM1", False)
    rig.run(0.1)
    assert rig.client.all("measured_js")


def test_invalid_data_is_stamped_zero_by_2_4_and_not_said_at_all_by_2_3() -> None:
    for version in ("2.4", "2.3"):
        rig = ready(version)
        rig.server.cause("invalid", "PSM1", True)
        rig.run(0.1)
        stamps = [m.header.stamp.ns for m in rig.client.all("measured_js")]
        assert set(stamps) == ({0} if version == "2.4" else set())
        rig.server.cause("invalid", "PSM1", False)
        rig.run(0.1)
        assert rig.client.last("measured_js").header.stamp.ns > 0


def test_a_measurement_can_be_too_short_or_no_number(rig: Rig) -> None:
    rig.server.cause("short", "PSM1", True)
    rig.run(0.02)
    assert len(rig.client.last("measured_js").position) == 5
    assert len(rig.client.last("setpoint_js").position) == 6
    rig.server.cause("nan", "PSM1", True)
    rig.run(0.02)
    assert math.isnan(rig.client.last("measured_js").position[0])
    rig.server.cause("nan", "PSM1", False)
    rig.run(0.02)
    assert rig.client.last("measured_js").position == pytest.approx(rig.measured()[:6])


def test_a_teleoperation_says_that_it_follows(rig: Rig) -> None:
    node, heard = Inproc(rig.exchange), list[bool]()
    node.subscribe("/MTMR_PSM1/following", Bool, lambda m, _: heard.append(m.data), True)
    for is_on in (True, False):
        rig.server.cause("following", "PSM1", is_on)
    assert heard == [False, True, False]


def test_a_second_commander_draws_the_setpoint_away_from_what_was_sent(rig: Rig) -> None:
    motion = rig.server.arms["PSM1"].arm.motion
    held = motion.setpoint.jp
    rig.server.cause("second commander", "PSM1", True)
    rig.client.joints("servo_jp", held[0] - 0.02, *held[1:])
    rig.run(0.1)
    assert rig.client.last("setpoint_js").position == held
    rig.server.cause("second commander", "PSM1", False)
    rig.client.joints("servo_jp", held[0] - 0.02, *held[1:])
    rig.run(0.1)
    assert rig.client.last("setpoint_js").position[0] == held[0] - 0.02


@pytest.mark.parametrize(("version", "topic"), [("2.4", "IO/arm_clutch"), ("2.3", "manip_clutch")])
def test_while_the_clutch_is_pressed_the_arm_is_busy_and_takes_no_command(
    version: str, topic: str
) -> None:
    rig = ready(version)
    node, buttons = Inproc(rig.exchange), list[tuple[int, ...]]()
    node.subscribe(f"/PSM1/{topic}", Joy, lambda m, _: buttons.append(m.buttons), True)
    q = rig.server.arms["PSM1"].arm.motion.setpoint.jp
    rig.client.joints("move_jp", q[0] - 0.3, *q[1:])
    rig.run(0.1)
    rig.server.cause("clutch", "PSM1", True)
    rig.run(0.02)
    assert rig.client.summary == ("ENABLED", True, True)
    rig.client.joints("servo_jp", *q)
    rig.run(0.02)
    assert "arm not ready" in rig.client.texts("warning")[0]
    rig.server.cause("clutch", "PSM1", False)
    rig.run(0.02)
    assert rig.client.summary == ("ENABLED", True, False)
    assert buttons == [(1,), (0,)]
    rig.client.joints("servo_jp", *rig.measured()[:6])
    rig.run(0.02)
    assert rig.client.state.state == "ENABLED"


def test_without_its_instrument_an_arm_has_seven_actuators_no_pose_and_does_not_move(
    rig: Rig,
) -> None:
    where = rig.measured()
    rig.server.cause("tool", "PSM1", True)
    rig.run(0.02)
    assert rig.client.last("tool_type").data == ""
    js = rig.client.last("measured_js")
    assert len(js.name) == len(js.position) == len(js.velocity) == 7
    assert js.position[:3] == pytest.approx(where[:3])
    arm = rig.cell.world.cell.arms[0].arm
    assert arm.actuator_to_joint @ js.position[3:] == pytest.approx(where[3:], abs=1e-6)
    assert rig.client.last("measured_cp").header.stamp.ns == 0
    rig.client.joints("servo_jp", 0.0, 0.0, 0.1, 0.0, 0.0, 0.0)
    rig.run(0.02)
    assert "arm not ready" in rig.client.texts("warning")[0]
    rig.server.cause("tool", "PSM1", False)
    rig.run(0.02)
    assert rig.client.summary == ("ENABLED", False, True)
    rig.until_idle()
    assert rig.client.summary == ("ENABLED", True, False)
    assert rig.client.last("tool_type").data == "LARGE_NEEDLE_DRIVER:400006"
    assert rig.measured() == pytest.approx(where, abs=1e-3)


def test_2_3_says_no_poses_without_an_instrument() -> None:
    rig = ready("2.3")
    rig.server.cause("tool", "PSM1", True)
    rig.run(PERIOD_S)
    rig.client.forget()
    rig.run(0.1)
    assert rig.client.all("measured_cp") == rig.client.all("body/jacobian") == []
    assert rig.client.all("measured_js")


def test_an_instrument_can_be_emulated_and_named(rig: Rig) -> None:
    rig.client.send("emulate_tool_present", Bool(False))
    rig.run(0.02)
    assert rig.client.last("tool_type").data == ""
    rig.client.send("set_tool_type", String("MARYLAND_BIPOLAR_FORCEPS:400172"))
    rig.run(0.02)
    assert rig.client.last("tool_type").data == "MARYLAND_BIPOLAR_FORCEPS:400172"


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("large_needle_driver_400006", "LARGE_NEEDLE_DRIVER:400006"),
        ("prograsp_forceps_420093_geared", "PROGRASP_FORCEPS:420093_GEARED"),
        ("stapler_45_410298", "STAPLER_45:410298"),
        ("probe", "PROBE"),
    ],
)
def test_instruments_have_dvrks_names(file: str, name: str) -> None:
    assert tool_type(file) == name


@pytest.mark.parametrize("fault", get_args(Fault))
def test_every_fault_can_be_ended_and_the_arm_be_had_back(rig: Rig, fault: str) -> None:
    rig.server.cause(fault, "PSM1", True)
    rig.run(0.5)
    rig.server.cause(fault, "PSM1", False)
    rig.run(1.0)
    assert recovers(rig)
    rig.client.forget()
    rig.run(0.1)
    q = rig.client.last("setpoint_js").position
    assert q == pytest.approx(rig.measured()[:6], abs=1e-3)
    assert rig.client.last("measured_js").header.stamp.ns > 0


def test_a_fault_or_an_arm_that_is_none_is_refused(rig: Rig) -> None:
    with pytest.raises(DriverError, match="there are tracking, potentiometers"):
        rig.server.cause("fire", "PSM1", True)
    with pytest.raises(DriverError, match="PSM1, PSM2"):
        rig.server.cause("power", "ECM", True)
