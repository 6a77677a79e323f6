"""The messages of CRTK, field for field as ROS defines them, independent of any middleware.

A transport makes its own types from these (`fields_of`), so that what goes over ROS 1, ROS 2 and
plain DDS cannot differ. Names and order of fields are those of std_msgs, geometry_msgs, sensor_msgs
and crtk_msgs 1.3.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, get_args, get_origin, get_type_hints

NANO = 1_000_000_000

Int32 = Annotated[int, "int32"]
UInt32 = Annotated[int, "uint32"]
Float32 = Annotated[float, "float32"]
Float64 = Annotated[float, "float64"]
Text = Annotated[str, "string"]
Flag = Annotated[bool, "bool"]


@dataclass(frozen=True, slots=True)
class Time:
    """Unix time of the sender's computer; zero says "no valid data" (dVRK 2.4)."""

    ROS: ClassVar = "builtin_interfaces/Time"
    sec: Int32 = 0
    nanosec: UInt32 = 0

    @classmethod
    def of_ns(cls, ns: int) -> Time:
        """From nanoseconds since 1970."""
        return cls(ns // NANO, ns % NANO)

    @property
    def ns(self) -> int:
        """Nanoseconds since 1970."""
        return self.sec * NANO + self.nanosec


@dataclass(frozen=True, slots=True)
class Header:
    """When something was so, and in which frame."""

    ROS: ClassVar = "std_msgs/Header"
    stamp: Time = Time()
    frame_id: Text = ""


@dataclass(frozen=True, slots=True)
class Point:
    """m."""

    ROS: ClassVar = "geometry_msgs/Point"
    x: Float64 = 0.0
    y: Float64 = 0.0
    z: Float64 = 0.0


@dataclass(frozen=True, slots=True)
class Vector3:
    """m/s, rad/s, N or N m."""

    ROS: ClassVar = "geometry_msgs/Vector3"
    x: Float64 = 0.0
    y: Float64 = 0.0
    z: Float64 = 0.0


@dataclass(frozen=True, slots=True)
class Quaternion:
    """Unit quaternion."""

    ROS: ClassVar = "geometry_msgs/Quaternion"
    x: Float64 = 0.0
    y: Float64 = 0.0
    z: Float64 = 0.0
    w: Float64 = 1.0


@dataclass(frozen=True, slots=True)
class Pose:
    """Position, m, and orientation."""

    ROS: ClassVar = "geometry_msgs/Pose"
    position: Point = Point()
    orientation: Quaternion = Quaternion()


@dataclass(frozen=True, slots=True)
class Twist:
    """Linear and angular velocity."""

    ROS: ClassVar = "geometry_msgs/Twist"
    linear: Vector3 = Vector3()
    angular: Vector3 = Vector3()


@dataclass(frozen=True, slots=True)
class Wrench:
    """Force, N, and torque, N m."""

    ROS: ClassVar = "geometry_msgs/Wrench"
    force: Vector3 = Vector3()
    torque: Vector3 = Vector3()


@dataclass(frozen=True, slots=True)
class PoseStamped:
    """A pose of a moment."""

    ROS: ClassVar = "geometry_msgs/PoseStamped"
    header: Header = Header()
    pose: Pose = Pose()


@dataclass(frozen=True, slots=True)
class TwistStamped:
    """A velocity of a moment."""

    ROS: ClassVar = "geometry_msgs/TwistStamped"
    header: Header = Header()
    twist: Twist = Twist()


@dataclass(frozen=True, slots=True)
class WrenchStamped:
    """A wrench of a moment."""

    ROS: ClassVar = "geometry_msgs/WrenchStamped"
    header: Header = Header()
    wrench: Wrench = Wrench()


@dataclass(frozen=True, slots=True)
class JointState:
    """Joints, rad or m; an empty tuple says nothing of its kind."""

    ROS: ClassVar = "sensor_msgs/JointState"
    header: Header = Header()
    name: tuple[Text, ...] = ()
    position: tuple[Float64, ...] = ()
    velocity: tuple[Float64, ...] = ()
    effort: tuple[Float64, ...] = ()


@dataclass(frozen=True, slots=True)
class Joy:
    """Pedals and buttons: buttons[0] is 1 pressed, 0 released, 2 clicked."""

    ROS: ClassVar = "sensor_msgs/Joy"
    header: Header = Header()
    axes: tuple[Float32, ...] = ()
    buttons: tuple[Int32, ...] = ()


@dataclass(frozen=True, slots=True)
class OperatingState:
    """DISABLED, ENABLED, PAUSED or FAULT, and what goes with it."""

    ROS: ClassVar = "crtk_msgs/OperatingState"
    header: Header = Header()
    state: Text = ""
    is_homed: Flag = False
    is_busy: Flag = False


@dataclass(frozen=True, slots=True)
class StringStamped:
    """A word of a moment, such as a state command."""

    ROS: ClassVar = "crtk_msgs/StringStamped"
    header: Header = Header()
    string: Text = ""


@dataclass(frozen=True, slots=True)
class Bool:
    """Yes or no."""

    ROS: ClassVar = "std_msgs/Bool"
    data: Flag = False


@dataclass(frozen=True, slots=True)
class String:
    """A text."""

    ROS: ClassVar = "std_msgs/String"
    data: Text = ""


@dataclass(frozen=True, slots=True)
class Float:
    """A number."""

    ROS: ClassVar = "std_msgs/Float64"
    data: Float64 = 0.0


@dataclass(frozen=True, slots=True)
class Empty:
    """Nothing but that it was sent."""

    ROS: ClassVar = "std_msgs/Empty"


@dataclass(frozen=True, slots=True)
class MultiArrayDimension:
    """One dimension of a matrix."""

    ROS: ClassVar = "std_msgs/MultiArrayDimension"
    label: Text = ""
    size: UInt32 = 0
    stride: UInt32 = 0


@dataclass(frozen=True, slots=True)
class MultiArrayLayout:
    """How the numbers of a matrix are laid out."""

    ROS: ClassVar = "std_msgs/MultiArrayLayout"
    dim: tuple[MultiArrayDimension, ...] = ()
    data_offset: UInt32 = 0


@dataclass(frozen=True, slots=True)
class Float64MultiArray:
    """A matrix."""

    ROS: ClassVar = "std_msgs/Float64MultiArray"
    layout: MultiArrayLayout = MultiArrayLayout()
    data: tuple[Float64, ...] = ()


@dataclass(frozen=True, slots=True)
class ForwardKinematicsRequest:
    """Joints, rad or m; fewer than the arm has ask for a frame on the way. dVRK ignores `cp`."""

    ROS: ClassVar = "crtk_msgs/QueryForwardKinematics"
    jp: tuple[Float64, ...] = ()
    cp: Pose = Pose()


@dataclass(frozen=True, slots=True)
class ForwardKinematicsResponse:
    """The pose of the tip, or why there is none."""

    ROS: ClassVar = "crtk_msgs/QueryForwardKinematics"
    cp: Pose = Pose()
    result: Flag = False
    message: Text = ""


@dataclass(frozen=True, slots=True)
class InverseKinematicsRequest:
    """A pose of the tip and joints to start from."""

    ROS: ClassVar = "crtk_msgs/QueryInverseKinematics"
    cp: Pose = Pose()
    jp: tuple[Float64, ...] = ()


@dataclass(frozen=True, slots=True)
class InverseKinematicsResponse:
    """Joints of a pose, or why there are none."""

    ROS: ClassVar = "crtk_msgs/QueryInverseKinematics"
    jp: tuple[Float64, ...] = ()
    result: Flag = False
    message: Text = ""


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a message, for transports that build or fill types of their own.

    Attributes:
        name: as ROS calls it.
        kind: "float64", "string", …, or the dataclass of a nested message.
        is_sequence: any number of them.
    """

    name: str
    kind: str | type[Any]
    is_sequence: bool


def fields_of(message: type[Any]) -> tuple[Field, ...]:
    """The fields of a message's class, in the order on the wire."""
    hints = get_type_hints(message, include_extras=True)
    found = []
    for entry in dataclasses.fields(message):
        hint = hints[entry.name]
        is_sequence = get_origin(hint) is tuple
        kind = get_args(hint)[0] if is_sequence else hint
        if get_origin(kind) is Annotated:
            kind = kind.__metadata__[0]
        found.append(Field(entry.name, kind, is_sequence))
    return tuple(found)
