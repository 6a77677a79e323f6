"""Which transports this environment can open, what the others lack, and which one to take."""

from __future__ import annotations

import importlib.util
import os
from dataclasses import dataclass

from viskill_deploy.core.errors import MissingExtraError
from viskill_deploy.drivers.crtk.transport import TransportName

MODULES: dict[TransportName, tuple[str, ...]] = {
    "ros1": ("rospy", "genpy"),
    "ros2": ("rclpy", "crtk_msgs", "sensor_msgs", "geometry_msgs", "std_msgs"),
    "dds": ("cyclonedds",),
}
"""What each must be able to import."""

ADVICE: dict[TransportName, str] = {
    "ros1": "on Debian or Ubuntu: apt-get install python3-rospy, and let this Python see "
    "/usr/lib/python3/dist-packages after its own packages (tests/ros/install does it with a .pth "
    "file); in a ROS installation: source its setup.bash",
    "ros2": "source the setup.bash of ROS 2 and that of dVRK's workspace, which has crtk_msgs, and "
    "use that ROS's Python from 3.11 on (python3 -m venv --system-site-packages); or say dds, "
    "which needs no ROS",
    "dds": "pip install 'viskill-deploy[ros]'",
}
"""What to do where something is missing."""


@dataclass(frozen=True, slots=True)
class Readiness:
    """Whether a transport can be opened here.

    Attributes:
        name: of the transport.
        missing: modules that cannot be found; none when it is ready.
        advice: what to do about it.
    """

    name: TransportName
    missing: tuple[str, ...]
    advice: str


@dataclass(frozen=True, slots=True)
class Choice:
    """A transport, and why it is this one."""

    name: TransportName
    reason: str


def readiness(name: TransportName) -> Readiness:
    """What a transport lacks here; nothing is imported."""
    missing = tuple(m for m in MODULES[name] if importlib.util.find_spec(m) is None)
    return Readiness(name, missing, ADVICE[name] if missing else "")


def choose() -> Choice:
    """The transport of the robot that this environment was made for.

    ROS 1 where a setup.bash of it was sourced, else ROS 2 where it is installed with CRTK's
    messages, else plain DDS, which any ROS 2 hears.

    Raises:
        MissingExtraError: there is none.
    """
    if os.environ.get("ROS_VERSION") == "1" and not readiness("ros1").missing:
        return Choice("ros1", "ROS_VERSION is 1 and rospy is here")
    missing = readiness("ros2").missing
    if not missing:
        return Choice("ros2", "rclpy and crtk_msgs are here")
    if not readiness("dds").missing:
        return Choice("dds", f"cyclonedds is here; ros2 would need {', '.join(missing)}")
    raise MissingExtraError("ros", "CRTK without ROS (or with ROS 1, but ROS_VERSION is not 1)")
