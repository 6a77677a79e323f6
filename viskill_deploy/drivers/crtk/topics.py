"""The one table of CRTK topics: what a dVRK arm and its console offer, and who publishes it.

Driver, server, guard and tests all read it. Names are those of dVRK 2.4; where 2.2 and 2.3 differ
the older name stands beside. Source: sawIntuitiveResearchKit and its ROS bridge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from viskill_deploy.drivers.crtk.messages import (
    Bool,
    Empty,
    Float,
    Float64MultiArray,
    ForwardKinematicsRequest,
    ForwardKinematicsResponse,
    InverseKinematicsRequest,
    InverseKinematicsResponse,
    JointState,
    Joy,
    OperatingState,
    PoseStamped,
    String,
    StringStamped,
    TwistStamped,
    WrenchStamped,
)

Version = Literal["2.4", "2.3"]
"""Of the dVRK software; "2.3" stands for 2.2 too."""


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic.

    Attributes:
        name: without the arm's name in front.
        message: what it carries.
        publisher: the robot ("server") or who commands it ("client").
        is_latched: who comes late gets the last one (ROS 2: TRANSIENT_LOCAL).
        is_periodic: published all the time, 100 times a second by default; else at changes.
        is_demanded: dVRK's own Python client insists on it.
        old_name: what dVRK 2.2 and 2.3 call it; "" where they call it the same.
    """

    name: str
    message: type[Any]
    publisher: Literal["server", "client"]
    is_latched: bool = False
    is_periodic: bool = False
    is_demanded: bool = True
    old_name: str = ""


@dataclass(frozen=True, slots=True)
class Service:
    """One service of an arm; where the transport has services."""

    name: str
    request: type[Any]
    response: type[Any]


def _periodic(name: str, message: type[Any]) -> Topic:
    return Topic(name, message, "server", is_periodic=True)


def _event(name: str, message: type[Any], is_demanded: bool = False, old: str = "") -> Topic:
    return Topic(name, message, "server", True, is_demanded=is_demanded, old_name=old)


def _command(name: str, message: type[Any], is_demanded: bool = True) -> Topic:
    return Topic(name, message, "client", is_demanded=is_demanded)


ARM: tuple[Topic, ...] = (
    _event("operating_state", OperatingState, is_demanded=True),
    _periodic("measured_js", JointState),
    _periodic("setpoint_js", JointState),
    _periodic("jaw/measured_js", JointState),
    _periodic("jaw/setpoint_js", JointState),
    _periodic("measured_cp", PoseStamped),
    _periodic("setpoint_cp", PoseStamped),
    _periodic("local/measured_cp", PoseStamped),
    _periodic("local/setpoint_cp", PoseStamped),
    _periodic("measured_cv", TwistStamped),
    _periodic("body/measured_cf", WrenchStamped),
    _periodic("spatial/measured_cf", WrenchStamped),
    _periodic("body/jacobian", Float64MultiArray),
    _periodic("spatial/jacobian", Float64MultiArray),
    _event("trajectory_j/ratio", Float, is_demanded=True),
    _event("desired_state", String),
    _event("goal_reached", Bool),
    _event("error", String),
    _event("warning", String),
    _event("status", String),
    _event("tool_type", String),
    _event("IO/arm_clutch", Joy, old="manip_clutch"),
    _command("state_command", StringStamped),
    _command("hold", Empty),
    _command("free", Empty),
    _command("servo_jp", JointState),
    _command("servo_jr", JointState),
    _command("servo_jf", JointState),
    _command("move_jp", JointState),
    _command("move_jr", JointState),
    _command("jaw/servo_jp", JointState),
    _command("jaw/servo_jf", JointState),
    _command("jaw/move_jp", JointState),
    _command("servo_cp", PoseStamped),
    _command("move_cp", PoseStamped),
    _command("body/servo_cf", WrenchStamped),
    _command("spatial/servo_cf", WrenchStamped),
    _command("body/set_cf_orientation_absolute", Bool),
    _command("use_gravity_compensation", Bool),
    _command("emulate_tool_present", Bool),
    _command("trajectory_j/set_ratio", Float),
    _command("set_tool_type", String, is_demanded=False),
)
"""Of one arm; "/PSM1/" stands in front."""

CONSOLE: tuple[Topic, ...] = (
    _event("console/operator_present", Joy),
    _event("console/clutch", Joy),
    _command("console/emulate_operator_present", Joy, is_demanded=False),
    _command("console/emulate_clutch", Joy, is_demanded=False),
    _command("system/power_on", Empty, is_demanded=False),
    _command("system/power_off", Empty, is_demanded=False),
    _command("system/home", Empty, is_demanded=False),
)
"""Of the console and the system; "/" stands in front. dVRK 2.2 and 2.3 say console/ for system/."""

SERVICES: tuple[Service, ...] = (
    Service("forward_kinematics", ForwardKinematicsRequest, ForwardKinematicsResponse),
    Service("local/forward_kinematics", ForwardKinematicsRequest, ForwardKinematicsResponse),
    Service("inverse_kinematics", InverseKinematicsRequest, InverseKinematicsResponse),
)

_BY_NAME = {topic.name: topic for topic in (*ARM, *CONSOLE)}


def topic(name: str) -> Topic:
    """The topic called so, without an arm's name."""
    return _BY_NAME[name]


def named(topic: Topic, version: Version) -> str:
    """What a version of dVRK calls a topic; an arm's name still has to stand in front."""
    if version == "2.4":
        return topic.name
    return topic.old_name or topic.name.replace("system/", "console/")


def following(arm: str) -> str:
    """Topic, Bool, by which a teleoperation says that it sends commands to an arm.

    The master's number is the arm's: MTMR drives PSM1, MTML drives PSM2 (dVRK's usual pairing).
    """
    return f"/{MASTERS.get(arm, 'MTMR')}_{arm}/following"


def followings(arm: str) -> tuple[str, ...]:
    """The same of every master that could drive an arm."""
    return tuple(f"/{master}_{arm}/following" for master in sorted(set(MASTERS.values())))


MASTERS = {"PSM1": "MTMR", "PSM2": "MTML", "PSM3": "MTMR"}
