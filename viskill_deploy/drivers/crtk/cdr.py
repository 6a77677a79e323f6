"""The bytes of ROS 2's messages: plain CDR, version 1, from the fields of a message alone.

CycloneDDS could do the same from its own types, at four times the cost.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import lru_cache
from operator import attrgetter
from typing import Any, Final

from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.crtk.messages import Field, fields_of

Put = Callable[[Any, bytearray], None]
"""Appends a value; the length of the buffer says how it is aligned."""

Get = Callable[[bytes, int, str], tuple[Any, int]]
"""A value at a place, in the byte order "<" or ">", and where the next one may begin."""

FORMATS = {"bool": "?", "int32": "i", "uint32": "I", "float32": "f", "float64": "d"}
SAME: Final = 64
"""Lists of texts whose bytes are kept; arms say the names of their joints all the time."""

LITTLE, ORDERS = b"\x00\x01\x00\x00", {b"\x00\x00": ">", b"\x00\x01": "<"}


def encoder(message: type[Any]) -> Callable[[Any], bytes]:
    """What writes a message, little endian, after the four bytes that say so."""
    put = _put_all(message)

    def encode(word: Any) -> bytes:
        body = bytearray()
        put(word, body)
        return LITTLE + body

    return encode


def decoder(message: type[Any]) -> Callable[[bytes], Any]:
    """What reads a message in either byte order.

    The function returned raises a `DriverError` for bytes that are no such message.
    """
    get = _get_all(message)

    def decode(data: bytes) -> Any:
        order = ORDERS.get(data[:2])
        if order is None:
            raise DriverError(f"a {message.ROS} came in another form than plain CDR")
        try:
            return get(data[4:], 0, order)[0]
        except (struct.error, IndexError) as error:
            raise DriverError(f"a {message.ROS} is cut short; is it of the same ROS?") from error

    return decode


def _put_all(message: type[Any]) -> Put:
    parts = [(attrgetter(field.name), _put(field)) for field in fields_of(message)]
    if not parts:
        return lambda word, body: body.append(0)  # ROS 2 puts a dummy into what has no field

    def put(word: Any, body: bytearray) -> None:
        for get, one in parts:
            one(get(word), body)

    return put


def _put(field: Field) -> Put:
    if not isinstance(field.kind, str):
        one = _put_all(field.kind)
    elif field.kind == "string":
        if field.is_sequence:
            return _put_texts
        one = _put_text
    elif field.is_sequence:
        return _put_numbers(FORMATS[field.kind])
    else:
        return _put_number(FORMATS[field.kind])
    return _put_each(one) if field.is_sequence else one


def _put_number(letter: str) -> Put:
    pack, size = struct.Struct(f"<{letter}").pack, struct.calcsize(f"<{letter}")

    def put(value: Any, body: bytearray) -> None:
        body += bytes(-len(body) % size) + pack(value)

    return put


def _put_numbers(letter: str) -> Put:
    size = struct.calcsize(f"<{letter}")

    def put(values: Any, body: bytearray) -> None:
        _put_count(len(values), body)
        if values:
            body += bytes(-len(body) % size) + struct.pack(f"<{len(values)}{letter}", *values)

    return put


def _put_each(one: Put) -> Put:
    def put(values: Any, body: bytearray) -> None:
        _put_count(len(values), body)
        for value in values:
            one(value, body)

    return put


_put_count = _put_number("I")


def _put_text(value: Any, body: bytearray) -> None:
    text = value.encode()
    _put_count(len(text) + 1, body)
    body += text + b"\x00"


@lru_cache(maxsize=SAME)
def _texts(values: tuple[str, ...]) -> bytes:
    body = bytearray()
    _put_all_texts(values, body)
    return bytes(body)


_put_all_texts = _put_each(_put_text)


def _put_texts(values: Any, body: bytearray) -> None:
    """Texts begin with a count, whose place in a message does not change how they are aligned."""
    body += bytes(-len(body) % 4)
    body += _texts(tuple(values))


def _get_all(message: type[Any]) -> Get:
    parts = [_get(field) for field in fields_of(message)]

    def get(data: bytes, at: int, order: str) -> tuple[Any, int]:
        values = []
        for one in parts:
            value, at = one(data, at, order)
            values.append(value)
        return message(*values), at

    return get


def _get(field: Field) -> Get:
    if not isinstance(field.kind, str):
        one = _get_all(field.kind)
    elif field.kind == "string":
        if field.is_sequence:
            return _get_texts()
        one = _get_text
    elif field.is_sequence:
        return _get_numbers(FORMATS[field.kind])
    else:
        return _get_number(FORMATS[field.kind])
    return _get_each(one) if field.is_sequence else one


def _get_number(letter: str) -> Get:
    size = struct.calcsize(f"<{letter}")

    def get(data: bytes, at: int, order: str) -> tuple[Any, int]:
        at += -at % size
        return struct.unpack_from(order + letter, data, at)[0], at + size

    return get


def _get_numbers(letter: str) -> Get:
    size = struct.calcsize(f"<{letter}")

    def get(data: bytes, at: int, order: str) -> tuple[Any, int]:
        count, at = _get_count(data, at, order)
        if not count:
            return (), at
        at += -at % size
        if at + count * size > len(data):
            raise IndexError(count)
        return struct.unpack_from(f"{order}{count}{letter}", data, at), at + count * size

    return get


def _get_each(one: Get) -> Get:
    def get(data: bytes, at: int, order: str) -> tuple[Any, int]:
        count, at = _get_count(data, at, order)
        values = []
        for _ in range(count):  # ends at the first that is not there
            value, at = one(data, at, order)
            values.append(value)
        return tuple(values), at

    return get


_get_count = _get_number("I")


def _get_text(data: bytes, at: int, order: str) -> tuple[Any, int]:
    """A text; what is no UTF-8 in it is marked, so that no odd warning makes us deaf."""
    size, at = _get_count(data, at, order)
    if not size or at + size > len(data):
        raise IndexError(size)
    return data[at : at + size - 1].decode(errors="replace"), at + size


def _get_texts() -> Get:
    """Texts that a sender says again and again, such as names of joints, are read once."""
    get, known = _get_each(_get_text), dict[str, tuple[bytes, tuple[str, ...]]]()

    def get_again(data: bytes, at: int, order: str) -> tuple[Any, int]:
        at += -at % 4
        raw, values = known.get(order, (b"", ()))
        if raw and data.startswith(raw, at):
            return values, at + len(raw)
        values, end = get(data, at, order)
        known[order] = data[at:end], values
        return values, end

    return get_again
