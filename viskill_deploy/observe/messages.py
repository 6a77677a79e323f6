"""The message types of a recording: name, definition text and ROS 2 type hash (RIHS01).

The definitions are those of common_interfaces without their comments. `Verdict` is the project's
own; `docs/recording.md` tells how to have it known to a ROS installation.
"""

from __future__ import annotations

from dataclasses import dataclass

_SEPARATOR = "=" * 80
_HEADER = "builtin_interfaces/Time stamp\nstring frame_id\n"
_TIME = "int32 sec\nuint32 nanosec\n"
_POINT = "float64 x\nfloat64 y\nfloat64 z\n"
_QUATERNION = "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
_STAMPED = {"std_msgs/Header": _HEADER, "builtin_interfaces/Time": _TIME}


@dataclass(frozen=True, slots=True)
class MessageType:
    """One type of message.

    Attributes:
        name: such as "sensor_msgs/msg/JointState".
        definition: the .msg text followed by the texts of all types that it uses.
        rihs01: the type's hash, for the bag's metadata.
    """

    name: str
    definition: str
    rihs01: str


def _joined(own: str, parts: dict[str, str]) -> str:
    return own + "".join(f"{_SEPARATOR}\nMSG: {name}\n{text}" for name, text in parts.items())


JOINT_STATE = MessageType(
    "sensor_msgs/msg/JointState",
    _joined(
        "std_msgs/Header header\n"
        "string[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n",
        _STAMPED,
    ),
    "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
)
POSE_STAMPED = MessageType(
    "geometry_msgs/msg/PoseStamped",
    _joined(
        "std_msgs/Header header\ngeometry_msgs/Pose pose\n",
        {
            **_STAMPED,
            "geometry_msgs/Pose": (
                "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
            ),
            "geometry_msgs/Point": _POINT,
            "geometry_msgs/Quaternion": _QUATERNION,
        },
    ),
    "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
)
STRING = MessageType(
    "std_msgs/msg/String",
    "string data\n",
    "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
)
VERDICT = MessageType(
    "viskill_msgs/msg/Verdict",
    _joined(
        "std_msgs/Header header\n"
        "uint8 action\nstring rule\nint8 arm\nint8 joint\n"
        "float64 value\nfloat64 limit\nstring mode\n",
        _STAMPED,
    ),
    "RIHS01_389aa4e7b3f898a9c9a88315488eece7daf5e21a41683e05274d3289da520a22",
)
TYPES = (JOINT_STATE, POSE_STAMPED, STRING, VERDICT)
