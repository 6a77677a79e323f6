"""The classes of ROS 1 for our messages, made from their fields as ROS makes them from its files.

What ROS compares before it connects, the hash of a definition, comes out as on the robot; no
package of messages has to be installed.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import genmsg
import genpy
from genpy.dynamic import generate_dynamic

from viskill_deploy.drivers.crtk.definitions import definition
from viskill_deploy.drivers.crtk.messages import Time, fields_of

NAMES = {"sec": "secs", "nanosec": "nsecs"}
"""Our names of fields that ROS 1 calls otherwise."""

_CLASSES: dict[str, Any] = {}


def ros1_class(message: type[Any], suffix: str = "") -> Any:
    """The class of one of `messages`.

    Args:
        message: of `messages`.
        suffix: "Request" or "Response" for half of a service.
    """
    if message is Time:
        return genpy.Time
    name = message.ROS + suffix
    if name not in _CLASSES:
        parts = [f"MSG: {part.ROS}\n{definition(part, 1)}" for part in _parts(message)]
        text = f"\n{'=' * 80}\n".join((definition(message, 1), *parts))
        for found, kind in generate_dynamic(name, text).items():
            _CLASSES.setdefault(found, kind)
    return _CLASSES[name]


def service_class(request: type[Any], response: type[Any]) -> Any:
    """The class of a service, with the hash by which ROS knows it."""
    context = genmsg.MsgContext.create_default()
    for part in {*_parts(request), *_parts(response)}:
        genmsg.msg_loader.load_msg_from_string(context, definition(part, 1), part.ROS)
    text = f"{definition(request, 1)}---\n{definition(response, 1)}"
    spec = genmsg.msg_loader.load_srv_from_string(context, text, request.ROS)
    content = {
        "_type": request.ROS,
        "_md5sum": genmsg.compute_md5(context, spec),
        "_request_class": ros1_class(request, "Request"),
        "_response_class": ros1_class(response, "Response"),
    }
    return type(request.ROS.split("/")[1], (), content)


def _parts(message: type[Any]) -> Iterator[type[Any]]:
    """The messages inside a message; time is built into ROS 1."""
    for field in fields_of(message):
        if not isinstance(field.kind, str) and field.kind is not Time:
            yield field.kind
            yield from _parts(field.kind)
