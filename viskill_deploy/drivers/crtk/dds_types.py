"""The types of ROS 2 as plain DDS sees them: final structs with the names and fields of ROS 2."""

from __future__ import annotations

from typing import Any

from cyclonedds.idl import make_idl_struct, types
from cyclonedds.idl.annotations import final

from viskill_deploy.drivers.crtk.messages import Field, fields_of

KINDS: dict[str, Any] = {
    "bool": bool,
    "int32": types.int32,
    "uint32": types.uint32,
    "float32": types.float32,
    "float64": types.float64,
    "string": str,
}

DUMMY = "structure_needs_at_least_one_member"
"""What ROS 2 puts into a message without fields."""


def dds_type(message: type[Any]) -> Any:
    """A struct for one of `messages`, such as `sensor_msgs::msg::dds_::JointState_`."""
    package, name = message.ROS.split("/")
    fields = {field.name: _kind(field) for field in fields_of(message)} or {DUMMY: types.uint8}
    return final(make_idl_struct(f"{name}_", f"{package}.msg.dds_.{name}_", fields))


def _kind(field: Field) -> Any:
    one = KINDS[field.kind] if isinstance(field.kind, str) else dds_type(field.kind)
    return types.sequence[one] if field.is_sequence else one


def carrier(message: type[Any]) -> Any:
    """The struct of a message that holds its bytes, `data`, and nothing else.

    CycloneDDS takes the bytes that it sends from `serialize` and gives those that came to
    `deserialize`, so that `cdr` can do the work, four times faster than its own codec.

    One struct a message in the whole process: CycloneDDS knows types by their class, and with more
    than 32 classes of one name it looks for a place for the next one for ever.
    """
    if message not in _CARRIERS:
        _CARRIERS[message] = _made(message)
    return _CARRIERS[message]


_CARRIERS: dict[type[Any], Any] = {}


def _made(message: type[Any]) -> Any:
    box = dds_type(message)

    def hold(self: Any, data: bytes) -> None:
        self.data = data

    def serialize(self: Any, **_: Any) -> bytes:
        held: bytes = self.data
        return held

    def deserialize(data: bytes, **_: Any) -> Any:
        return box(data)

    box.__init__, box.serialize = hold, serialize
    box.deserialize = box.deserialize_key = staticmethod(deserialize)
    return box
