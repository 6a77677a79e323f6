"""Settings by which the implementations of DDS keep to one interface.

There is no call for it: each reads its own XML, while a node is made.
"""

from __future__ import annotations

import ipaddress
import os
import socket
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager

from viskill_deploy.core.errors import DriverError

CYCLONE = """<CycloneDDS><Domain><General>{multicast}<Interfaces>
<NetworkInterface address="{address}"{option}/></Interfaces></General>{discovery}
</Domain></CycloneDDS>"""

CYCLONE_DISCOVERY = """<Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
<Peers><Peer address="{address}"/></Peers></Discovery>"""

FAST = """<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="http://www.eprosima.com"><profiles>
<transport_descriptors><transport_descriptor>
<transport_id>one</transport_id><type>UDPv4</type>
<maxInitialPeersRange>32</maxInitialPeersRange>
<interfaceWhiteList><address>{address}</address></interfaceWhiteList>
</transport_descriptor></transport_descriptors>
<participant profile_name="one" is_default_profile="true"><rtps>
<userTransports><transport_id>one</transport_id></userTransports>
<useBuiltinTransports>false</useBuiltinTransports>{discovery}
</rtps></participant></profiles></dds>
"""

FAST_DISCOVERY = """<builtin>
<metatrafficUnicastLocatorList><locator><udpv4><address>{address}</address></udpv4></locator>
</metatrafficUnicastLocatorList>
<initialPeersList><locator><udpv4><address>{address}</address></udpv4></locator></initialPeersList>
</builtin>"""


def is_loopback(interface: str) -> bool:
    """Whether an address is this machine's own."""
    return interface.startswith("127.")


def demand_own(interface: str) -> None:
    """Refuses what is no address of this machine; Fast DDS would speak on others instead.

    Args:
        interface: an IPv4 address, or "".

    Raises:
        DriverError: it is not ours.
    """
    if not interface:
        return
    try:
        ipaddress.IPv4Address(interface)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
            one.bind((interface, 0))
    except (ValueError, OSError) as error:
        raise DriverError(
            f"{interface} is no IPv4 address of this machine ({error}); `ip address` lists them"
        ) from error


def cyclone_settings(interface: str) -> str:
    """CycloneDDS's settings for an interface.

    Args:
        interface: address of this machine; one of loopback goes without multicast, and finds the
            others on this machine by their port numbers.
    """
    local = is_loopback(interface)
    return CYCLONE.format(
        address=interface,
        multicast="<AllowMulticast>false</AllowMulticast>" if local else "",
        option=' multicast="false"' if local else "",
        discovery=CYCLONE_DISCOVERY.format(address=interface) if local else "",
    )


def fast_settings(interface: str) -> str:
    """Fast DDS's settings for an interface; see `cyclone_settings`."""
    local = is_loopback(interface)
    discovery = FAST_DISCOVERY.format(address=interface) if local else ""
    return FAST.format(address=interface, discovery=discovery)


@contextmanager
def ros2_environment(interface: str) -> Iterator[None]:
    """The environment in which nodes of ROS 2 keep to an interface.

    Args:
        interface: address of this machine; "" changes nothing.
    """
    if not interface:
        yield
        return
    before = dict(os.environ)
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        file.write(fast_settings(interface))
        file.flush()
        for name in ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE"):
            os.environ[name] = file.name
        os.environ["CYCLONEDDS_URI"] = cyclone_settings(interface)
        if is_loopback(interface):  # the settings above say all; ROS's own would add sockets
            os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SYSTEM_DEFAULT"
        try:
            yield
        finally:
            os.environ.clear()
            os.environ.update(before)
