"""A `torch.save` file as plain dicts and numpy arrays, without torch and without running anything.

The file is a zip archive of stored entries: `<root>/data.pkl` and the numbers of every tensor in
`<root>/data/<key>`. `NAMES` is the whole list of what a pickle in it may name.
"""

from __future__ import annotations

import struct
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from viskill_deploy.bundle.official.pickle_data import (
    MAX_BYTES,
    PickleRefusedError,
    read_pickle,
)
from viskill_deploy.core.errors import BundleError

MAX_FILE_BYTES = 256 * 2**20
"""An official chaining checkpoint has 15 MB."""

MAX_ENTRIES = 10_000
ZIP_ERRORS = (
    OSError,
    zipfile.BadZipFile,
    NotImplementedError,
    RuntimeError,
    EOFError,
    ValueError,
    struct.error,
)
"""What Python's zip reader raises on broken archives."""

DTYPES: Mapping[str, np.dtype[Any]] = {
    "f4": np.dtype("<f4"),
    "f8": np.dtype("<f8"),
    "i8": np.dtype("<i8"),
}
AGAIN = "; get the checkpoint again from where it was trained"

Float32Array = npt.NDArray[np.float32]


class Attributes(dict[str, Any]):
    """Stand-in for an OrderedDict, whose own attributes (torch keeps versions there) are left."""

    def set_state(self, state: Any) -> None:
        """Leaves them."""


class Record:
    """Stand-in for an object of plain attributes.

    Attributes:
        fields: the attributes by name.
    """

    def __init__(self) -> None:
        self.fields: dict[str, Any] = {}

    def set_state(self, state: Any) -> None:
        """Takes the attributes; raises ValueError when they are no dict."""
        if not isinstance(state, dict):
            raise ValueError("the attributes of a Normalizer are no table")
        self.fields = state


class DType:
    """Stand-in for a numpy dtype: one of `DTYPES`, little-endian."""

    def __init__(self, code: str, align: Any = False, copy: Any = True) -> None:
        if code not in DTYPES:
            raise ValueError(f"numbers of type {code!r} are not known")
        self.numpy = DTYPES[code]

    def set_state(self, state: Any) -> None:
        """Checks the byte order; raises ValueError for another."""
        if not (isinstance(state, tuple) and len(state) >= 2 and state[1] == "<"):
            raise ValueError("numbers that are not little-endian are not known")


class Array:
    """Stand-in for a numpy array.

    Attributes:
        values: the array, once its state is known.
    """

    def __init__(self) -> None:
        self.values: npt.NDArray[Any] = np.empty(0)

    def set_state(self, state: Any) -> None:
        """Takes shape and bytes; raises ValueError when they do not fit."""
        _, shape, dtype, is_fortran, content = state
        flat = _numbers(dtype, content)
        self.values = flat.reshape(shape, order="F" if is_fortran else "C")


def _numbers(dtype: Any, content: Any) -> npt.NDArray[Any]:
    if not isinstance(dtype, DType) or not isinstance(content, bytes):
        raise ValueError("an array has no numbers")
    return np.frombuffer(content, dtype.numpy)


def _scalar(dtype: Any, content: Any) -> float:
    (value,) = _numbers(dtype, content)
    return float(value)


def _encode(text: Any, encoding: Any) -> bytes:
    """Bytes that protocol 2 has written as text."""
    if not isinstance(text, str) or encoding != "latin1":
        raise ValueError("bytes are written in an unknown way")
    return text.encode("latin1")


def _array(kind: Any, shape: Any, code: Any) -> Array:
    return Array()


def _ndarray(*_: Any) -> Array:
    raise ValueError("an array is made in an unknown way")


def _float_storage(*_: Any) -> Any:
    raise ValueError("a storage is made in an unknown way")


def _tensor(
    storage: Any, offset: Any, size: Any, stride: Any, requires_grad: Any, hooks: Any
) -> Float32Array:
    """A tensor as a view of its storage; raises ValueError when it reaches outside."""
    if not isinstance(storage, np.ndarray) or len(size) != len(stride):
        raise ValueError("a tensor has no storage")
    numbers = (offset, *size, *stride)
    if not all(isinstance(n, int) and 0 <= n < 2**31 for n in numbers):
        raise ValueError("a tensor has an impossible shape")
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if 0 in size or last >= storage.size:
        raise ValueError("a tensor is larger than its storage")
    strides = [4 * step for step in stride]
    view = np.lib.stride_tricks.as_strided(storage[offset:], size, strides, writeable=False)
    if view.size > storage.size:
        raise ValueError("a tensor is larger than its storage")
    return np.ascontiguousarray(view)


def _names() -> dict[str, Callable[..., Any]]:
    names: dict[str, Callable[..., Any]] = {
        "_codecs.encode": _encode,
        "collections.OrderedDict": Attributes,
        "numpy.dtype": DType,
        "numpy.ndarray": _ndarray,
        "torch.FloatStorage": _float_storage,
        "torch._utils._rebuild_tensor_v2": _tensor,
        "viskill.components.normalizer.Normalizer": Record,
    }
    for package in ("numpy.core.multiarray", "numpy._core.multiarray"):  # numpy 1, numpy 2
        names |= {f"{package}._reconstruct": _array, f"{package}.scalar": _scalar}
    return names


NAMES: Mapping[str, Callable[..., Any]] = _names()


def read_torch_file(path: Path) -> dict[str, Any]:
    """The dict in a checkpoint; tensors as float32 arrays.

    Raises:
        BundleError: no such file, another format, or anything that a checkpoint does not need.
            Nothing of the file was run.
    """
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise BundleError(path, f"is larger than any official checkpoint{AGAIN}")
        with zipfile.ZipFile(path) as archive:
            entries = _checked(path, archive)
            content = read_pickle(
                archive.read(entries.pickle), NAMES, partial(_storage, archive, entries)
            )
    except BundleError:
        raise
    except PickleRefusedError as error:
        raise BundleError(path, f"{error}{AGAIN}") from error
    except ZIP_ERRORS as error:
        raise BundleError(
            path, f"is no complete file of torch.save's zip format ({error}){AGAIN}"
        ) from error
    if not isinstance(content, dict):
        raise BundleError(path, f"holds no table of weights{AGAIN}")
    return content


@dataclass(frozen=True)
class _Entries:
    """The archive's pickle, and its entries by name below the root."""

    pickle: zipfile.ZipInfo
    data: dict[str, zipfile.ZipInfo]


def _checked(path: Path, archive: zipfile.ZipFile) -> _Entries:
    """Every entry stored as it is, inside one root folder, no larger than the file."""
    room, root, data = path.stat().st_size, "", {}
    infos = archive.infolist()
    if len(infos) > MAX_ENTRIES:
        raise BundleError(path, f"has {len(infos)} entries, far more than a checkpoint{AGAIN}")
    for info in infos:
        top, *rest = info.filename.split("/")
        root = root or top
        is_inside = top == root and rest and not {"", ".", ".."} & {top, *rest}
        if not is_inside or "\\" in info.filename or ":" in info.filename:
            raise BundleError(
                path, f"has an entry {info.filename!r} outside its folder: it may be an attack"
            )
        room -= info.file_size
        if info.compress_type != zipfile.ZIP_STORED or room < 0:
            raise BundleError(
                path,
                f"has an entry {info.filename!r} that claims {info.file_size} bytes, more than "
                f"the file holds{AGAIN}",
            )
        name = "/".join(rest)
        if name in data:
            raise BundleError(path, f"has two entries {info.filename!r}{AGAIN}")
        data[name] = info
    if "data.pkl" not in data or data["data.pkl"].file_size > MAX_BYTES:
        raise BundleError(path, f"holds no data.pkl of a checkpoint's size{AGAIN}")
    order = data.get("byteorder")
    if order is not None and archive.read(order) != b"little":
        raise BundleError(
            path, "has numbers that are not little-endian; save it on another machine"
        )
    return _Entries(data["data.pkl"], data)


def _storage(archive: zipfile.ZipFile, entries: _Entries, pid: Any) -> Float32Array:
    """The numbers of a storage; the device that they were on (cpu, cuda:0) does not matter."""
    kind, storage, key, _, count = pid
    if kind != "storage" or storage is not _float_storage:
        raise ValueError("a tensor is not of 32-bit floats")
    info = entries.data.get(f"data/{key}")
    if info is None or info.file_size != 4 * count:
        raise ValueError(f"the numbers of tensor {key} are missing or cut off")
    return np.frombuffer(archive.read(info), "<f4")
