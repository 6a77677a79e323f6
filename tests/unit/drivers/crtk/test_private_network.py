"""Simulated robots do not meet each other, nor real ones."""

import pytest

from viskill_deploy.core.errors import DriverError, MissingRosError
from viskill_deploy.drivers.crtk import private_network
from viskill_deploy.drivers.crtk.opening import LOOPBACK
from viskill_deploy.drivers.crtk.private_network import PrivateNetwork


def test_two_simulated_robots_have_two_domains_on_this_machine_only():
    first, second = PrivateNetwork("dds"), PrivateNetwork("ros2")
    assert first.network.domain != second.network.domain
    assert first.network.interface == second.network.interface == LOOPBACK
    first.close()
    third = PrivateNetwork("dds")
    assert third.network.domain == first.network.domain
    second.close()
    third.close()


def test_when_every_domain_is_taken_nobody_shares_one(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(private_network, "LAST_DOMAIN", private_network.FIRST_DOMAIN - 1)
    with pytest.raises(DriverError, match="end other simulations"):
        PrivateNetwork("dds")


def test_a_robot_of_ros_1_is_not_put_on_the_master_that_happens_to_be_there(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.setenv("ROS_MASTER_URI", "http://a-robot:11311")
    with pytest.raises(MissingRosError, match="rosmaster"):
        PrivateNetwork("ros1")


def test_a_master_that_does_not_come_up_is_an_error(
    monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
):
    broken = tmp_path_factory.mktemp("bin") / "rosmaster"
    broken.write_text("#!/bin/sh\nexit 1\n")
    broken.chmod(0o755)
    for name in ("ROS_MASTER_URI", "ROS_IP", "ROS_HOSTNAME"):
        monkeypatch.setenv(name, "")
    monkeypatch.setenv("PATH", f"{broken.parent}:/usr/bin:/bin")
    with pytest.raises(DriverError, match="does not come up"):
        PrivateNetwork("ros1")
