"""The bus between processes of one machine: whole frames, no echo, one group, nothing outside."""

import os
import select
import socket
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.can.line import CanLine
from viskill_deploy.drivers.can.multicast import HERE, PORT, LoopbackMulticast

GROUPS = [f"239.74.{os.getpid() % 251}.{n}" for n in (2, 3)]


@pytest.fixture
def lines() -> Iterator[list[CanLine]]:
    """Two ends of one bus, and one of another."""
    channels = (GROUPS[0], GROUPS[0], GROUPS[1])
    made = [CanLine("PSM1", "udp_multicast", channel) for channel in channels]
    yield made
    for line in made:
        line.close()


def arrived(line: CanLine) -> list[tuple[int, bytes]]:
    assert select.select([line], [], [], 2.0)[0], "no frame came"
    return line.drain()


def test_frames_reach_the_other_end_whole_and_in_order(lines: list[CanLine]) -> None:
    frames = [(0x201, bytes([n, 255])) for n in range(100)]
    for identifier, data in frames:
        lines[0].send(identifier, data)
    seen: list[tuple[int, bytes]] = []
    while len(seen) < len(frames):
        seen += arrived(lines[1])
    assert seen == frames


def test_no_bus_hears_itself_or_another_group(lines: list[CanLine]) -> None:
    lines[0].send(0x201, b"mine")
    assert arrived(lines[1]) == [(0x201, b"mine")]
    assert lines[0].drain() == []
    assert lines[2].drain() == []
    assert lines[2].foreign == 0


@pytest.mark.parametrize(
    "data",
    [b"", b"\xc1", b"\x93\x01\x02\x03", b"\x81\xa4data\x01", b"noise" * 9, bytes(4096)],
)
def test_a_datagram_that_is_no_frame_is_counted_and_dropped(
    lines: list[CanLine], data: bytes
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(HERE))
        stranger.sendto(data, (GROUPS[0], PORT))
    assert arrived(lines[1]) == []
    assert lines[1].foreign == 1


def test_fast_frames_are_foreign_on_a_classic_bus(lines: list[CanLine]) -> None:
    fast = CanLine("PSM1", "udp_multicast", GROUPS[0], is_fd=True)
    fast.send(0x201, bytes(6), cyclic=True)
    assert arrived(lines[0]) == []
    assert lines[0].foreign == 1
    fast.close()


def test_nothing_leaves_the_machine() -> None:
    bus = LoopbackMulticast(GROUPS[0])
    try:
        assert bus._mouth.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL) == 0
        way_out = bus._mouth.getsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, 4)
        assert socket.inet_ntoa(way_out) == HERE
        assert memberships(GROUPS[0]) == ["lo"]
    finally:
        bus.shutdown()


def test_frames_from_a_network_are_heard_by_python_cans_own_bus_and_not_by_this_one() -> None:
    ours = LoopbackMulticast(GROUPS[0])
    try:
        theirs = can.Bus(interface="udp_multicast", channel=GROUPS[0], hop_limit=0)
    except can.CanInitializationError:
        ours.shutdown()
        pytest.skip("this machine has no network besides its loopback")
    try:
        theirs.send(can.Message(arbitration_id=1, is_extended_id=False))
        heard = theirs.recv(1.0)  # it is on the network, and comes back from there
        assert heard is not None
        assert ours.recv(0.05) is None
    finally:
        ours.shutdown()
        theirs.shutdown()


def memberships(group: str) -> list[str]:
    """Interfaces on which anybody of this machine listens to a group, from the kernel's table."""
    found, interface = [], ""
    little_endian = socket.inet_aton(group)[::-1].hex().upper()
    for line in Path("/proc/net/igmp").read_text().splitlines()[1:]:
        words = line.split()
        if words[2:3] == [":"]:
            interface = words[1]
        elif words[0] == little_endian:
            found.append(interface)
    return found


@pytest.mark.parametrize("channel", ["10.0.0.1", "can0", "", "ff15::1"])
def test_what_is_no_group_is_refused_with_what_to_look_at(channel: str) -> None:
    with pytest.raises(DriverError, match="look at interface and channel"):
        CanLine("PSM1", "udp_multicast", channel)
