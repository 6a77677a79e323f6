"""Message records laid out once and then filled by the thousand.

A ROS 2 message whose strings do not change has every number at a fixed offset. So one message,
CDR-encoded and wrapped as an MCAP record, is laid out as a template with named holes; a whole
column of messages is the template repeated, and its numbers are set by numpy, a field at a time.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

from viskill_deploy.core.types import FloatArray

RECORD_HEAD = struct.Struct("<BQHIQQ")
"""MCAP message record: opcode, length, channel, sequence, log time, publish time."""

_MESSAGE = 0x05
_CDR_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_SIZES = {"B": 1, "b": 1, "I": 4, "i": 4, "d": 8}
_NUMPY = {"B": "u1", "b": "i1", "I": "<u4", "i": "<i4", "d": "<f8"}


class Layout:
    """Builds the CDR (plain, little endian) encoding of one message with holes in it.

    Alignment is counted from the byte after the four bytes of encapsulation.
    """

    def __init__(self) -> None:
        self._data = bytearray()
        self._fields: dict[str, tuple[str, int, int]] = {}

    def _align(self, size: int) -> None:
        self._data += bytes(-len(self._data) % size)

    def put(self, code: str, value: float) -> Layout:
        """A number that never changes; `code` is struct's letter."""
        self._align(_SIZES[code])
        self._data += struct.pack("<" + code, value)
        return self

    def hole(self, name: str, code: str, count: int = 1) -> Layout:
        """`count` numbers in a row to be set in each message."""
        self._align(_SIZES[code])
        self._fields[name] = (_NUMPY[code], count, len(self._data))
        self._data += bytes(_SIZES[code] * count)
        return self

    def text(self, text: str) -> Layout:
        """A string that never changes."""
        encoded = text.encode() + b"\0"
        self.put("I", len(encoded))
        self._data += encoded
        return self

    def header(self, frame_id: str) -> Layout:
        """std_msgs/Header with its stamp left open."""
        return self.hole("sec", "i").hole("nanosec", "I").text(frame_id)

    def numbers(self, name: str, count: int) -> Layout:
        """A sequence of `count` doubles to be set."""
        return self.put("I", count).hole(name, "d", count)

    def column(self, channel: int) -> Column:
        """The finished layout, as records of an MCAP channel."""
        return Column(channel, bytes(self._data), self._fields)


class Column:
    """Messages of one channel and one layout.

    Attributes:
        channel: MCAP id of the channel.
        dtype: one record, with the holes as fields.
    """

    def __init__(self, channel: int, data: bytes, fields: dict[str, tuple[str, int, int]]) -> None:
        body = _CDR_LITTLE_ENDIAN + data
        size = RECORD_HEAD.size + len(body)
        head = RECORD_HEAD.pack(_MESSAGE, size - 9, channel, 0, 0, 0)
        start = RECORD_HEAD.size + len(_CDR_LITTLE_ENDIAN)
        holes = {name: (f, n, start + offset) for name, (f, n, offset) in fields.items()}
        holes |= {"log": ("<u8", 1, 15), "publish": ("<u8", 1, 23)}
        self.channel = channel
        self._stamped = "sec" in fields
        self.dtype = np.dtype(
            {
                "names": list(holes),
                "formats": [(f, n) if n > 1 else f for f, n, _ in holes.values()],
                "offsets": [offset for _, _, offset in holes.values()],
                "itemsize": size,
            }
        )
        self._template = head + body

    def records(self, log_ns: np.ndarray, stamp_ns: np.ndarray) -> np.ndarray:
        """One record a time, (n,): logged at `log_ns`, stamped `stamp_ns`; other holes are zero."""
        # numpy copies the fields of a record but not the bytes between them, so bytes it is
        table = np.frombuffer(bytearray(self._template * len(log_ns)), self.dtype)
        table["log"] = log_ns
        table["publish"] = stamp_ns
        if self._stamped:
            table["sec"], table["nanosec"] = np.divmod(stamp_ns, 1_000_000_000)
        return table


def joint_state(names: Sequence[str]) -> Layout:
    """sensor_msgs/JointState with holes `position` and `velocity`, no effort."""
    layout = Layout().header("").put("I", len(names))
    for name in names:
        layout.text(name)
    count = len(names)
    return layout.numbers("position", count).numbers("velocity", count).put("I", 0)


def pose_stamped(frame_id: str) -> Layout:
    """geometry_msgs/PoseStamped with holes `position` (3) and `orientation` (x, y, z, w)."""
    return Layout().header(frame_id).hole("position", "d", 3).hole("orientation", "d", 4)


def verdict(rule: str, mode: str) -> Layout:
    """viskill_msgs/Verdict of one rule in one mode."""
    layout = Layout().header("").hole("action", "B").text(rule)
    layout.hole("arm", "b").hole("joint", "b").hole("value", "d").hole("limit", "d")
    return layout.text(mode)


def string(text: str) -> Layout:
    """std_msgs/String."""
    return Layout().text(text)


def quaternions(T: FloatArray) -> FloatArray:
    """Unit quaternions x, y, z, w of poses or rotations (n, 3+, 3+), (n, 4), w >= 0.

    Each is taken from the column of the symmetric 4x4 quaternion product with the largest
    diagonal, so that no small number is divided by (Shepperd, J. Guidance and Control 1, 1978).
    """
    R = T[:, :3, :3]
    trace = np.trace(R, axis1=1, axis2=2)
    diagonal = np.stack([R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]], axis=1)
    product = np.empty((len(R), 4, 4))
    product[:, :3, :3] = R + R.transpose(0, 2, 1)
    product[:, [0, 1, 2], [0, 1, 2]] = 1 + 2 * diagonal - trace[:, None]
    axis = R.transpose(0, 2, 1) - R
    product[:, 3, :3] = product[:, :3, 3] = np.stack(
        [axis[:, 1, 2], axis[:, 2, 0], axis[:, 0, 1]], axis=1
    )
    product[:, 3, 3] = 1 + trace
    best = product[:, range(4), range(4)].argmax(axis=1)
    q = product[np.arange(len(R)), best]
    q = q / np.linalg.norm(q, axis=1, keepdims=True)
    return np.asarray(np.where(q[:, 3:] < 0, -q, q))
