"""Which transports this environment can open, what the others lack, and which one to take."""

from __future__ import annotations

import functools
import importlib.util
import os
import subprocess
import sys
from dataclasses import dataclass

from viskill_deploy.core.errors import MissingExtraError, extra_advice
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
    "dds": extra_advice("ros"),
}
"""What to do where something is missing."""


TRY = """
import importlib, os, sys
said, sys.stdout = sys.stdout, open(os.devnull, "w")
for name in sys.argv[1:]:
    try:
        importlib.import_module(name)
    except Exception:
        print(name, file=said, flush=True)
os._exit(0)
"""
TRY_S = 30.0


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
    """What a transport lacks here.

    What is there is imported too, by a process of its own: the packages of a ROS that was made for
    another Python are found and do not work.
    """
    modules = MODULES[name]
    missing = tuple(m for m in modules if importlib.util.find_spec(m) is None) or _useless(modules)
    return Readiness(name, missing, ADVICE[name] if missing else "")


@functools.cache
def _useless(modules: tuple[str, ...]) -> tuple[str, ...]:
    """Those that this Python cannot import."""
    command = [sys.executable, "-P", "-c", TRY, *modules]
    try:
        run = subprocess.run(command, capture_output=True, text=True, check=False, timeout=TRY_S)
    except subprocess.TimeoutExpired:
        return modules
    return tuple(run.stdout.split()) if run.returncode == 0 else modules


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
