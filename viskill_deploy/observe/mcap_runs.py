"""A reader of MCAP files that returns messages by the column.

It walks the file from its start and needs no index and no summary, so it also reads what a killed
recorder left. Messages of one channel and one size that lie behind each other come as one array.
"""

from __future__ import annotations

import mmap
import struct
import sys
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.errors import RecordingError
from viskill_deploy.observe.layout import RECORD_HEAD
from viskill_deploy.observe.mcap_file import CHANNEL, CHUNK, DATA_END, MAGIC, METADATA, SCHEMA

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

_RECORD = struct.Struct("<BQ")
_MESSAGE = 5
_CDR_HEAD = 4


@dataclass(frozen=True, slots=True)
class Run:
    """Messages of one topic, all of the same size.

    Attributes:
        topic: such as "/PSM1/measured_js".
        type: such as "sensor_msgs/msg/JointState".
        log_ns: log times, (n,).
        data: CDR bytes after the encapsulation, (n, size).
    """

    topic: str
    type: str
    log_ns: npt.NDArray[np.int64]
    data: npt.NDArray[np.uint8]


def _texts(data: bytes | mmap.mmap, at: int, count: int) -> list[str]:
    texts = []
    for _ in range(count):
        (size,) = struct.unpack_from("<I", data, at)
        texts.append(data[at + 4 : at + 4 + size].decode())
        at += 4 + size
    return texts


class RunFile:
    """An MCAP file, complete or cut off.

    Attributes:
        metadata: entries of the file's metadata records; known once `chunks` has begun.
        complete: whether the end of the data was reached; known after `chunks` has ended.

    Raises:
        RecordingError: not an MCAP file.
    """

    def __init__(self, path: Path) -> None:
        self.metadata: dict[str, str] = {}
        self.complete = False
        self._path = path
        self._types: dict[int, str] = {}
        self._topics: dict[int, tuple[str, str]] = {}
        try:
            with path.open("rb") as file:
                foreign = file.read(len(MAGIC)) != MAGIC
                # mapped, not read: a run of a hundred episodes is larger than what is asked of it
                self._data: bytes | mmap.mmap
                self._data = (
                    b"" if foreign else mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
                )
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read ({error}); check the path") from error
        if foreign:
            raise RecordingError(f"{path}: not an MCAP file; name the .mcap of a recording")

    def chunks(self) -> Iterator[list[Run]]:
        """The runs of each chunk, in the order of the file."""
        at, data = len(MAGIC), self._data
        while at + _RECORD.size <= len(data):
            opcode, size = _RECORD.unpack_from(data, at)
            at += _RECORD.size
            if at + size > len(data):
                return  # cut off in the middle of a record
            if opcode == CHUNK:
                yield list(self._runs(self._unpacked(at)))
            elif opcode == DATA_END:
                self.complete = True
                return
            else:
                self._learn(opcode, data[at : at + size])
            at += size

    def _learn(self, opcode: int, content: bytes) -> None:
        if opcode == SCHEMA:
            self._types[struct.unpack_from("<H", content)[0]] = _texts(content, 2, 1)[0]
        elif opcode == CHANNEL:
            channel, schema = struct.unpack_from("<HH", content)
            self._topics[channel] = (_texts(content, 4, 1)[0], self._types.get(schema, ""))
        elif opcode == METADATA:
            at = 4 + len(_texts(content, 0, 1)[0].encode())
            entries = content[at + 4 :]
            while entries:
                key, value = _texts(entries, 0, 2)
                self.metadata[key] = value
                entries = entries[8 + len(key.encode()) + len(value.encode()) :]

    def _unpacked(self, at: int) -> bytes:
        _, _, _, crc = struct.unpack_from("<QQQI", self._data, at)
        (compression,) = _texts(self._data, at + 28, 1)
        at += 32 + len(compression)
        (size,) = struct.unpack_from("<Q", self._data, at)
        packed = self._data[at + 8 : at + 8 + size]
        if compression not in {"", "zstd"}:
            raise RecordingError(f"{self._path}: {compression} chunks; convert them to zstd first")
        try:
            raw = zstd.decompress(packed) if compression else packed
        except zstd.ZstdError as error:
            raise RecordingError(f"{self._path}: damaged ({error}); copy it again") from error
        if crc and zlib.crc32(raw) != crc:
            raise RecordingError(f"{self._path}: damaged (wrong checksum); copy it again")
        return raw

    def _runs(self, raw: bytes) -> Iterator[Run]:
        at, whole = 0, np.frombuffer(raw, np.uint8)
        while at < len(raw):
            opcode, size = _RECORD.unpack_from(raw, at)
            stride = _RECORD.size + size
            if opcode != _MESSAGE:
                self._learn(opcode, raw[at + _RECORD.size : at + stride])
                at += stride
                continue
            count = (len(raw) - at) // stride
            rows = whole[at : at + count * stride].reshape(count, stride)
            same = (rows[:, :11] == rows[0, :11]).all(axis=1)  # opcode, size, channel
            length = count if same.all() else int(same.argmin())
            rows = rows[:length]
            channel = int(rows[0, 9]) | int(rows[0, 10]) << 8
            topic, kind = self._topics[channel]
            log = np.ascontiguousarray(rows[:, 15:23]).view("<i8")[:, 0]
            yield Run(topic, kind, log, rows[:, RECORD_HEAD.size + _CDR_HEAD :])
            at += length * stride
