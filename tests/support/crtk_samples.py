"""Messages of CRTK filled with values that are hard to carry, and what they are called."""

import random
import struct
from collections.abc import Callable
from typing import Any

from viskill_deploy.drivers.crtk import messages
from viskill_deploy.drivers.crtk.messages import fields_of
from viskill_deploy.drivers.crtk.topics import ARM, CONSOLE, Topic

MESSAGES: dict[str, type[Any]] = {
    kind.ROS: kind
    for kind in vars(messages).values()
    if isinstance(kind, type)
    and hasattr(kind, "ROS")
    and not kind.__name__.endswith(("Request", "Response"))
}
"""By their ROS names."""

TOPICS: tuple[Topic, ...] = tuple({topic.message: topic for topic in (*ARM, *CONSOLE)}.values())
"""One topic for each message of the table."""


def sample(message: type[Any], seed: int) -> Any:
    """A message whose every field says something."""
    return _filled(message, random.Random(seed))


def _filled(message: type[Any], chance: random.Random) -> Any:
    values = []
    for field in fields_of(message):
        count = chance.randrange(0, 9) if field.is_sequence else 1
        found = [_value(field.kind, chance) for _ in range(count)]
        values.append(tuple(found) if field.is_sequence else found[0])
    return message(*values)


def _value(kind: Any, chance: random.Random) -> Any:
    return VALUES[kind](chance) if isinstance(kind, str) else _filled(kind, chance)


VALUES: dict[str, Callable[[random.Random], Any]] = {
    "bool": lambda chance: chance.random() < 0.5,
    "int32": lambda chance: chance.randrange(2**31),
    "uint32": lambda chance: chance.randrange(10**9),
    "float32": lambda chance: struct.unpack("<f", struct.pack("<f", chance.gauss(0, 1e3)))[0],
    "float64": lambda chance: chance.choice((-0.0, 5e-324, 1e300, chance.gauss(0, 1))),
    "string": lambda chance: "".join(
        chance.choice("az 0µ夢/_:") for _ in range(chance.randrange(9))
    ),
}
