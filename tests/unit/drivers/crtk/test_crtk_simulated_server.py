"""The simulated dVRK as CRTK clients meet it: states, their order, who may say what and when."""

from __future__ import annotations

from itertools import pairwise

import pytest
from crtk_rig import PERIOD_S, Client, Rig

from viskill_deploy.core.clock import SteppedClock
from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.crtk.arm_on_wire import StaleCheck
from viskill_deploy.drivers.crtk.inproc import START_NS, Exchange, Inproc
from viskill_deploy.drivers.crtk.messages import (
    NANO,
    Bool,
    Empty,
    Float64MultiArray,
    Header,
    JointState,
    Joy,
    OperatingState,
    PoseStamped,
    StringStamped,
    Time,
    TwistStamped,
    WrenchStamped,
)
from viskill_deploy.drivers.crtk.messages import Float as Number
from viskill_deploy.drivers.crtk.server_options import ServerOptions
from viskill_deploy.drivers.crtk.simulated_cell import CrtkCell
from viskill_deploy.drivers.loopback_cell import LoopbackCell

CLIENT_HEARS = {
    "operating_state": OperatingState,
    "measured_js": JointState,
    "setpoint_js": JointState,
    "jaw/measured_js": JointState,
    "jaw/setpoint_js": JointState,
    "measured_cp": PoseStamped,
    "setpoint_cp": PoseStamped,
    "local/measured_cp": PoseStamped,
    "local/setpoint_cp": PoseStamped,
    "measured_cv": TwistStamped,
    "body/measured_cf": WrenchStamped,
    "spatial/measured_cf": WrenchStamped,
    "body/jacobian": Float64MultiArray,
    "spatial/jacobian": Float64MultiArray,
    "trajectory_j/ratio": Number,
}
CLIENT_SAYS = {
    "state_command": StringStamped,
    "hold": Empty,
    "free": Empty,
    "servo_jp": JointState,
    "servo_jr": JointState,
    "servo_jf": JointState,
    "move_jp": JointState,
    "move_jr": JointState,
    "jaw/servo_jp": JointState,
    "jaw/servo_jf": JointState,
    "jaw/move_jp": JointState,
    "servo_cp": PoseStamped,
    "move_cp": PoseStamped,
    "body/servo_cf": WrenchStamped,
    "spatial/servo_cf": WrenchStamped,
    "body/set_cf_orientation_absolute": Bool,
    "use_gravity_compensation": Bool,
    "emulate_tool_present": Bool,
    "trajectory_j/set_ratio": Number,
}
"""What dVRK's own Python client opens for a PSM; it goes on only when all have a peer."""


def test_every_endpoint_of_dvrks_own_client_has_a_peer_and_carries_what_it_expects() -> None:
    assert (len(CLIENT_HEARS), len(CLIENT_SAYS)) == (15, 19)
    rig = Rig()
    node = Inproc(rig.exchange)
    for arm in ("PSM1", "PSM2"):
        for name, message in CLIENT_HEARS.items():
            node.subscribe(f"/{arm}/{name}", message, lambda word, received_s: None)
        for name, message in CLIENT_SAYS.items():
            node.publisher(f"/{arm}/{name}", message)
        for name in (*CLIENT_HEARS, *CLIENT_SAYS):
            assert node.peers(f"/{arm}/{name}") > 0, name


def test_states_have_stamps_that_rise_even_when_time_stands_still() -> None:
    rig = Rig()
    for _ in range(3):
        rig.client.command("disable")
    rig.server.poll(rig.clock.now())
    stamps = [state.header.stamp.ns for state in rig.client.all("operating_state")]
    assert len(stamps) >= 5
    assert stamps[0] > START_NS
    assert all(a < b for a, b in pairwise(stamps))


def test_the_state_is_repeated_ten_times_a_second() -> None:
    rig = Rig()
    rig.client.forget()
    rig.run(2.0)
    assert 19 <= len(rig.client.all("operating_state")) <= 21


def test_who_comes_late_gets_the_last_state_at_once() -> None:
    rig = Rig()
    rig.make_ready()
    late = Client(rig.exchange)
    assert late.summary == ("ENABLED", True, False)
    assert late.last("tool_type").data == "LARGE_NEEDLE_DRIVER:400006"
    assert late.last("trajectory_j/ratio").data == 1.0


@pytest.mark.parametrize("word", ["enable", "disable", "home", "pause", "resume", "nonsense"])
def test_every_state_command_is_answered_by_the_state_also_when_nothing_changes(word: str) -> None:
    rig = Rig()
    rig.make_ready()
    rig.client.forget()
    rig.client.command(word)
    rig.server.poll(rig.clock.now())
    assert rig.client.all("operating_state")


def test_an_invalid_command_is_only_warned_about() -> None:
    rig = Rig()
    rig.client.command("home")
    rig.run(1.0)
    assert rig.client.summary == ("DISABLED", False, False)
    assert rig.client.texts("warning") == [
        'PSM1: command "home" is not supported in state DISABLED'
    ]
    assert rig.client.texts("error") == []


def test_an_arm_is_busy_while_it_gets_power() -> None:
    rig = Rig()
    rig.client.command("enable")
    rig.run(0.1)
    assert rig.client.summary == ("DISABLED", False, True)
    rig.client.command("enable")  # sent again by a client that was not heard
    rig.run(0.6)
    assert rig.client.summary == ("ENABLED", False, False)
    assert rig.client.texts("warning") == []


def test_arms_are_independent() -> None:
    rig = Rig()
    other = Client(rig.exchange, "PSM2")
    rig.make_ready()
    start = rig.measured(1)
    assert other.summary == ("DISABLED", False, False)
    other.joints("servo_jp", 0.0, 0.0, 0.12, 0.0, 0.0, 0.0)
    q = rig.client.last("setpoint_js").position
    rig.client.joints("servo_jp", q[0] + 0.02, *q[1:])
    rig.run(0.3)
    assert rig.measured(1) == pytest.approx(start, abs=1e-6)
    assert rig.measured(0)[0] == pytest.approx(q[0] + 0.02, abs=1e-3)
    assert other.texts("warning") == ["PSM2: servo_jp, arm not ready (1 errors)"]
    assert rig.client.texts("warning") == []


def test_only_the_arms_asked_for_are_on_the_wire() -> None:
    rig = Rig(ServerOptions(arms=("PSM2",)))
    assert rig.client.heard == []
    Client(rig.exchange, "PSM2").command("enable")
    rig.run(1.0)
    assert rig.cell.world.time_s > 1.0
    with pytest.raises(DriverError, match="PSM1, PSM2"):
        CrtkCell(rig.cell, Inproc(rig.exchange), ServerOptions(arms=("PSM3",)))


def test_two_clients_see_the_same_and_the_last_one_wins() -> None:
    rig = Rig()
    rig.make_ready()
    second = Client(rig.exchange)
    q = rig.client.last("setpoint_js").position
    rig.client.joints("servo_jp", q[0] + 0.01, *q[1:])
    second.joints("servo_jp", q[0] + 0.03, *q[1:])
    rig.run(0.2)
    for client in (rig.client, second):
        assert client.last("setpoint_js").position[0] == pytest.approx(q[0] + 0.03)


def test_state_commands_that_were_latched_for_an_earlier_server_move_nothing() -> None:
    clock = SteppedClock()
    exchange = Exchange(clock)
    cell = LoopbackCell(Rig(exchange=exchange).cell.world)  # an earlier server, to be replaced
    client = Client(exchange)
    for word in ("enable", "home"):
        client.command(word)
    exchange.lines.clear()  # the earlier server is gone; its client's words are still latched
    old = client.node.stamp_ns()
    clock.advance(0.5)
    start = cell.world.save()
    server = CrtkCell(cell, Inproc(exchange))
    client = Client(exchange)
    for word in ("enable", "home"):
        for stamp in (Time.of_ns(old), Time()):
            client.send("state_command", StringStamped(Header(stamp), word))
    server.poll(clock.now())
    for _ in range(250):
        clock.advance(PERIOD_S)
        server.advance(clock.now())
    assert client.summary == ("DISABLED", False, False)
    assert len(client.texts("warning")) == 4
    assert cell.world.save()[1:60] == pytest.approx(start[1:60], abs=1e-6)


def test_a_state_command_counts_from_the_start_of_the_server_and_for_five_seconds() -> None:
    check, start, now = StaleCheck(100 * NANO), 100 * NANO, 200 * NANO
    assert check.refusal(now, now) == ""
    assert check.refusal(start, start) == ""
    assert "before this server began" in check.refusal(start - 1, start)
    assert check.refusal(now - 5 * NANO, now) == ""
    assert "not of now" in check.refusal(now - 5 * NANO - 1, now)
    assert "not of now" in check.refusal(now + 5 * NANO + 1, now)


def test_a_client_that_does_not_stamp_is_obeyed_once_nothing_old_can_arrive_any_more() -> None:
    rig = Rig()
    rig.client.command("enable", stamped=False)
    rig.run(1.0)
    assert rig.client.summary == ("DISABLED", False, False)
    assert "has no stamp" in rig.client.texts("warning")[0]
    rig.run(4.0)
    rig.client.command("enable", stamped=False)
    rig.run(1.0)
    assert rig.client.summary == ("ENABLED", False, False)


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 250.0])
def test_readings_come_at_the_rate_asked_for(rate_hz: float) -> None:
    rig = Rig(ServerOptions(rate_hz=rate_hz))
    rig.client.forget()
    rig.run(1.0)
    for topic in ("measured_js", "jaw/setpoint_js", "local/measured_cp"):
        assert len(rig.client.all(topic)) == pytest.approx(rate_hz, abs=2)
    stamps = [m.header.stamp.ns for m in rig.client.all("measured_js")]
    assert all(a < b for a, b in pairwise(stamps))
    assert stamps[-1] > rig.client.node.stamp_ns() - 0.03 * NANO


def test_homing_goes_where_dvrks_simulation_goes_the_first_time_only() -> None:
    rig = Rig(ServerOptions(homing="dvrk"))
    rig.make_ready()
    rig.run(0.3)
    assert rig.measured() == pytest.approx((0.0, 0.0, 0.12, 0.0, 0.0, 0.0, 0.0), abs=2e-3)
    q = rig.client.last("setpoint_js").position
    rig.client.joints("move_jp", 0.1, *q[1:])
    rig.until_idle()
    for word in ("disable", "enable"):
        rig.client.command(word)
        rig.until_idle()
    assert rig.client.summary == ("ENABLED", False, False)
    rig.client.command("home")
    rig.until_idle()
    assert rig.client.summary == ("ENABLED", True, False)
    assert rig.measured()[0] == pytest.approx(0.1, abs=2e-3)
    rig.client.command("unhome")
    rig.run(0.02)
    rig.client.command("home")
    rig.until_idle()
    assert rig.measured()[0] == pytest.approx(0.0, abs=2e-3)


def test_homing_can_leave_an_arm_where_it_stands() -> None:
    rig = Rig(ServerOptions(homing="stay"))
    start = rig.measured()
    rig.make_ready()
    assert rig.measured() == pytest.approx(start, abs=1e-6)
    assert rig.client.last("setpoint_js").position == pytest.approx(start[:6], abs=1e-6)


def test_what_an_arm_is_asked_to_become_is_said_too() -> None:
    rig = Rig()
    rig.client.forget()
    rig.make_ready()
    rig.client.command("pause")
    rig.run(0.02)
    assert [m.data for m in rig.client.all("desired_state")] == ["ENABLED", "HOMED", "PAUSED"]


def test_who_looks_on_is_told_of_every_change() -> None:
    rig = Rig()
    rig.make_ready()
    told = [event for arm, event in rig.told if arm == "PSM1"]
    states = [what.state for topic, what in told if topic == "operating_state"]
    assert states[0] == "DISABLED"
    assert states[-1] == "ENABLED"
    assert {arm for arm, _ in rig.told} == {"PSM1", "PSM2"}


@pytest.mark.parametrize(
    "wrong", [{"version": "2.1"}, {"homing": "somewhere"}, {"rate_hz": 0.0}, {"scene_hz": 2e3}]
)
def test_options_that_make_no_sense_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(DriverError):
        ServerOptions(**wrong)  # type: ignore[arg-type]


def test_a_person_with_a_way_of_his_own_can_pause_and_disable_the_arms() -> None:
    rig = Rig()
    rig.make_ready()
    rig.cell.pause()
    rig.run(0.02)
    assert rig.client.summary == ("PAUSED", True, False)
    rig.client.command("resume")
    rig.run(0.02)
    rig.cell.disable()
    rig.run(0.02)
    assert rig.client.summary == ("DISABLED", False, False)


def test_arms_that_somebody_puts_elsewhere_hold_there() -> None:
    rig = Rig()
    rig.make_ready()
    home = rig.measured()
    q = rig.client.last("setpoint_js").position
    rig.client.joints("move_jp", q[0] + 0.2, *q[1:])
    rig.run(0.2)
    rig.cell.reset(rig.cell.scene(0.0))
    rig.run(0.3)
    assert rig.client.summary == ("ENABLED", True, False)
    assert rig.client.last("setpoint_js").position == pytest.approx(home[:6], abs=1e-3)
    assert rig.measured() == pytest.approx(home, abs=1e-3)


class Console:
    """A client of the console."""

    def __init__(self, rig: Rig, names: dict[str, str]) -> None:
        node = Inproc(rig.exchange)
        self.pedals: list[tuple[int, ...]] = []
        node.subscribe(
            "/console/operator_present", Joy, lambda m, _: self.pedals.append(m.buttons), True
        )
        self.emulate = node.publisher("/console/emulate_operator_present", Joy)
        self.say = {key: node.publisher(name, Empty) for key, name in names.items()}


@pytest.mark.parametrize(("version", "space"), [("2.4", "system"), ("2.3", "console")])
def test_console_gives_power_homes_and_takes_power(version: str, space: str) -> None:
    rig = Rig(ServerOptions(version=version, homing="stay"))  # type: ignore[arg-type]
    words = ("power_on", "power_off", "home")
    console = Console(rig, {word: f"/{space}/{word}" for word in words})
    console.say["power_on"](Empty())
    rig.run(0.7)
    assert rig.client.summary == ("ENABLED", False, False)
    console.say["power_off"](Empty())
    rig.run(0.02)
    assert rig.client.summary == ("DISABLED", False, False)
    console.say["home"](Empty())
    rig.run(0.7)
    assert rig.client.summary == ("ENABLED", True, False)
    rig.server.cause("tracking", "PSM1", True)
    rig.run(0.02)
    assert rig.client.state.state == "FAULT"
    console.say["home"](Empty())
    rig.run(0.7)
    assert rig.client.summary == ("ENABLED", True, False)


def test_the_operators_pedal_is_said_when_it_changes_and_can_be_emulated() -> None:
    rig = Rig()
    console = Console(rig, {})
    assert console.pedals == [(0,)]
    rig.cell.say(consent=True)
    rig.run(0.1)
    console.emulate(Joy(buttons=(0,)))
    rig.run(0.1)
    console.emulate(Joy(buttons=(1,)))
    rig.run(0.1)
    assert console.pedals == [(0,), (1,), (0,), (1,)]
    assert rig.cell.inputs(0.0).consent


def test_things_on_the_board_are_published_only_for_who_listens() -> None:
    rig = Rig()
    node, heard = Inproc(rig.exchange), list[PoseStamped]()
    node.subscribe("/scene/block1/measured_cp", PoseStamped, lambda m, _: heard.append(m))
    rig.run(1.1)
    assert len(heard) == pytest.approx(52, abs=5)
    T = rig.cell.scene(0.0).pose("block1")
    p = heard[-1].pose.position
    assert (p.x, p.y, p.z) == pytest.approx(T[:3, 3].tolist())
    assert heard[-1].header.frame_id == "task"
    assert heard[-1].header.stamp.ns > START_NS
