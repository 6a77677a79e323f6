"""How many setpoints arrive, and how old they are by then."""

import pytest
from crtk_rig import Rig
from scripted_arms import PLACE, Room

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.types import JointSetpoint
from viskill_deploy.drivers.crtk.contention import Sent
from viskill_deploy.drivers.crtk.driver import CrtkDriver, CrtkOptions
from viskill_deploy.drivers.crtk.messages import Header, JointState, Time
from viskill_deploy.drivers.watch import OwnTime
from viskill_deploy.observe.tables import plain_lines
from viskill_deploy.safety.checked import _TOKEN, CheckedSetpoint

REST = (0.0,) * 6


def at(yaw: float) -> JointSetpoint:
    return JointSetpoint((yaw, *PLACE[1:]), REST, 0.2, 0.0)


def test_the_age_of_what_an_arm_holds_is_told_while_it_moves_and_only_then() -> None:
    sent = Sent()
    for step, yaw in enumerate((0.1, 0.2, 0.3, 0.3, 0.3)):
        sent.note(at(yaw), 1.0 + 0.005 * step, (0.0,) * 7)
    assert sent.count == 5
    assert sent.age_s(at(0.2).jp, 1.012) == pytest.approx(0.007)
    assert sent.age_s(at(0.2).jp, 1.004) == 0.0, "clocks are not compared that exactly"
    assert sent.age_s(at(0.3).jp, 1.025) is None, "sent three times"
    assert sent.age_s(at(0.7).jp, 1.025) is None, "never sent"


def test_a_driver_tells_how_many_it_sent_and_how_old_they_were_when_the_arms_held_them() -> None:
    room = Room()
    driver = CrtkDriver(load_cell("bipegtransfer"), room.node, CrtkOptions(), OwnTime)
    driver.clock = room.clock
    driver.connect()
    assert driver.on_the_way() == {}
    driver.enable()
    driver.home()
    for step in range(100):
        wish = at(PLACE[0] + 1e-4 * step)
        driver.servo_jp([CheckedSetpoint(arm, wish, _TOKEN) for arm in range(2)])
        driver.clock.sleep_until(driver.clock.now() + driver.period_s)
        driver.state()
    way = driver.on_the_way()
    driver.close()
    assert way["sent"] == 200
    assert 0.0 <= way["echo_age_p50_ms"] <= way["echo_age_p99_ms"] <= 5.0 + 1e-6


def test_simulated_arms_count_what_they_hear_and_how_old_it_is() -> None:
    rig = Rig()
    rig.make_ready()
    q = rig.measured()[:6]
    for age_ns in (1_000_000, 2_000_000, 3_000_000, 0):
        stamp = Time.of_ns(rig.client.node.stamp_ns() - age_ns) if age_ns else Time()
        rig.client.send("servo_jp", JointState(Header(stamp), (), q))
        rig.run(0.004)
    told = {"heard": 4, "age_p50_ms": 2.0, "age_p99_ms": 2.98, "age_max_ms": 3.0}
    assert rig.server.heard() == pytest.approx(told)


def test_people_read_what_is_known_of_the_way() -> None:
    way = {"sent": 1000, "heard": 998, "lost": 2, "age_p50_ms": 0.61, "age_p99_ms": 1.94}
    lines = list(plain_lines({"on_the_way": way}))
    assert "setpoint age at arrival: 0.6 ms, p99 1.9 ms" in lines
    assert "lost on the way: 2 of 1,000" in lines
