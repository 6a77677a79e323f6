"""What dVRK calls the instruments of `robots/tools`."""

from __future__ import annotations

import re


def tool_type(tool: str) -> str:
    """The name on the topic `tool_type`, such as "LARGE_NEEDLE_DRIVER:400006".

    Args:
        tool: name of a file of `robots/tools`, such as "large_needle_driver_400006".
    """
    parts = re.fullmatch(r"(.+)_(\d{6})(?:_(.+))?", tool)
    if parts is None:
        return tool.upper()
    name, number, variant = parts.groups()
    return f"{name}:{number}{'_' + variant if variant else ''}".upper()
