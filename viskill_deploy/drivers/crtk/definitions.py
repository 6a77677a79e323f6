"""Our messages as the text of ROS's definition files."""

from __future__ import annotations

from typing import Any, Literal

from viskill_deploy.drivers.crtk.messages import Field, Header, Time, fields_of


def definition(message: type[Any], ros: Literal[1, 2]) -> str:
    """What a message's file says; time is built into ROS 1, whose header counts messages too."""
    lines = ["uint32 seq"] if message is Header and ros == 1 else []
    for field in fields_of(message):
        lines.append(f"{_kind(field, ros)}{'[]' * field.is_sequence} {field.name}")
    return "".join(f"{line}\n" for line in lines)


def _kind(field: Field, ros: Literal[1, 2]) -> str:
    if isinstance(field.kind, str):
        return field.kind
    return "time" if field.kind is Time and ros == 1 else str(field.kind.ROS)
