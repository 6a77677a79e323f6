"""What only plain DDS does: domains, interfaces, and what it cannot do."""

import socket
import threading
from pathlib import Path
from typing import Any

import pytest
from crtk_domain import DOMAIN
from crtk_peer import strays
from cyclonedds.core import DDSException
from test_transports import Ear

from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.crtk import dds
from viskill_deploy.drivers.crtk.loopback_only import confine
from viskill_deploy.drivers.crtk.messages import Bool
from viskill_deploy.drivers.crtk.opening import LOOPBACK, Network, open_transport


def handles() -> int:
    """How many files and sockets this process has open."""
    return len(list(Path("/proc/self/fd").iterdir()))


def test_services_are_refused() -> None:
    node = open_transport("dds", Network(DOMAIN, LOOPBACK))
    assert not node.has_services
    with pytest.raises(DriverError, match="ros2"):
        node.serve("/PSM1/inverse_kinematics", Bool, Bool, lambda request: request)
    node.close()


@pytest.mark.parametrize("refusals", [2, 3])
def test_a_topic_that_is_refused_is_tried_again(
    refusals: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, left = dds.Topic, [DDSException(-3)] * refusals

    def refusing(*arguments: Any) -> Any:
        if left:
            raise left.pop()
        return made(*arguments)

    monkeypatch.setattr(dds, "Topic", refusing)
    node = open_transport("dds", Network(DOMAIN, LOOPBACK))
    try:
        if refusals < len(dds.RETRIES_S):
            node.publisher("/PSM1/ready", Bool)(Bool(True))
        else:
            with pytest.raises(DriverError, match="/PSM1/ready: this topic does not open"):
                node.publisher("/PSM1/ready", Bool)
    finally:
        node.close()


def test_a_domain_is_on_one_interface_at_a_time() -> None:
    node = open_transport("dds", Network(DOMAIN, LOOPBACK))
    with pytest.raises(DriverError, match=r"on 127\.0\.0\.1 already"):
        open_transport("dds", Network(DOMAIN, "127.0.0.2"))
    with pytest.raises(DriverError, match="before one on any"):
        open_transport("dds", Network(DOMAIN))
    node.close()


@pytest.mark.parametrize("wrong", ["203.0.113.7", "127.0.0.1.5", "localhost", "::1", '1"/>'])
def test_an_interface_that_is_not_ours_is_an_error(wrong: str) -> None:
    with pytest.raises(DriverError, match="is no IPv4 address of this machine"):
        open_transport("dds", Network(DOMAIN + 1, wrong))


def test_the_environment_says_the_domain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "17")
    assert Network().domain_id() == 17
    assert Network(3).domain_id() == 3
    for wrong in ("233", "-1", "x", "1.5"):
        monkeypatch.setenv("ROS_DOMAIN_ID", wrong)
        with pytest.raises(DriverError, match="correct it"):
            Network().domain_id()
    monkeypatch.delenv("ROS_DOMAIN_ID")
    assert Network().domain_id() == 0


def test_two_domains_do_not_hear_each_other() -> None:
    here, there = (open_transport("dds", Network(DOMAIN + i, LOOPBACK)) for i in (2, 3))
    publish, near, far = here.publisher("/PSM1/goal_reached", Bool), Ear(), Ear()
    here.subscribe("/PSM1/goal_reached", Bool, near)
    there.subscribe("/PSM1/goal_reached", Bool, far)
    publish(Bool(True))
    near.wait_for(1)
    assert far.words == []
    assert there.peers("/PSM1/goal_reached") == 0
    here.close()
    there.close()


def test_a_closed_node_leaves_no_thread_and_no_socket_behind() -> None:
    threads, before = threading.active_count(), handles()
    node = open_transport("dds", Network(DOMAIN + 4, LOOPBACK))
    assert threading.active_count() == threads + 1
    assert handles() > before
    node.close()
    assert threading.active_count() == threads
    assert handles() == before


def test_stray_sockets_would_be_seen() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("0.0.0.0", 0))
        assert strays() == [f"udp 00000000:{one.getsockname()[1]}"]
    with socket.create_server(("::", 0), family=socket.AF_INET6) as one:
        assert strays() == [f"tcp6 {'0' * 32}:{one.getsockname()[1]}"]
    with socket.create_server(("127.0.0.3", 0)):
        assert strays() == []
    with socket.create_server(("::1", 0), family=socket.AF_INET6):
        assert strays() == []
    assert strays() == []


def test_a_domain_without_sockets_cannot_be_kept_to_this_machine() -> None:
    with pytest.raises(DriverError, match="no socket"):
        confine(DOMAIN + 5)


@pytest.mark.timeout(60)
def test_one_type_may_be_on_many_topics() -> None:
    """CycloneDDS finds no place for the 33rd of as many classes with one name, and looks on."""
    node = open_transport("dds", Network(DOMAIN, LOOPBACK))
    for index in range(40):
        node.publisher(f"/arm{index}/goal_reached", Bool)
    node.close()
