"""Between our messages and the classes that a middleware has for them, from their fields alone.

Nothing here is written for one message, so none can be converted in a way of its own.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from typing import Any

from viskill_deploy.drivers.crtk.messages import fields_of

Native = Callable[[type[Any]], Callable[..., Any]]
"""What makes the middleware's own value of one of our messages, from its fields by name."""

Names = Mapping[str, str]
"""Our name of a field to the middleware's, where they differ."""


def to_native(message: type[Any], native: Native, names: Names | None = None) -> Any:
    """What turns a value of `message` into the middleware's.

    Args:
        message: one of `messages`.
        native: the middleware's classes.
        names: fields that the middleware calls otherwise.

    Returns:
        A function of one value.
    """
    names, make = names or {}, native(message)
    parts = [
        (names.get(field.name, field.name), operator.attrgetter(field.name), turn)
        for field, turn in _turns(message, lambda kind: to_native(kind, native, names), list)
    ]

    def convert(word: Any) -> Any:
        return make(**{name: turn(get(word)) for name, get, turn in parts})

    return convert


def from_native(message: type[Any], names: Names | None = None) -> Any:
    """What turns the middleware's value of a `message` into ours; the inverse of `to_native`."""
    names = names or {}
    parts = [
        (operator.attrgetter(names.get(field.name, field.name)), turn)
        for field, turn in _turns(message, lambda kind: from_native(kind, names), tuple)
    ]

    def convert(sample: Any) -> Any:
        return message(*[turn(get(sample)) for get, turn in parts])

    return convert


def _turns(message: type[Any], nested: Any, gather: Any) -> list[tuple[Any, Any]]:
    """Every field of a message, and what turns its value."""
    found = []
    for field in fields_of(message):
        one = _as_it_is if isinstance(field.kind, str) else nested(field.kind)
        found.append((field, _each(one, gather) if field.is_sequence else one))
    return found


def _each(one: Any, gather: Any) -> Any:
    if one is _as_it_is:
        return gather
    return lambda values: gather(one(value) for value in values)


def _as_it_is(value: Any) -> Any:
    return value
