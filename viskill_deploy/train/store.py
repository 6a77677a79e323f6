"""Nested plain values on disk: arrays and JSON in one file, no pickle."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from viskill_deploy.core.errors import TrainingError

Tree = Mapping[str, Any]
"""Names to arrays, numbers, strings, None, lists of such, or further trees."""

_ARRAY = "__array__"


def save(path: Path, tree: Tree) -> None:
    """Writes `tree`; a crash leaves the old file whole.

    Args:
        path: the file, its folder made if missing.
        tree: what to write.
    """
    arrays: dict[str, Any] = {}
    skeleton = json.dumps(_without_arrays(tree, arrays), allow_nan=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(f"{path.name}.new")
    try:
        with new.open("wb") as file:
            np.savez(file, __tree__=np.array(skeleton), **arrays)
        new.replace(path)
    finally:
        new.unlink(missing_ok=True)  # half a file would keep a full disk full


def load(path: Path) -> dict[str, Any]:
    """What `save` wrote.

    Raises:
        TrainingError: the file is missing or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
        skeleton = json.loads(str(arrays.pop("__tree__")))
        tree: dict[str, Any] = _with_arrays(skeleton, arrays)
    except (OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise TrainingError(
            f"{path} cannot be read ({error}); delete it and train again"
        ) from error
    return tree


def _without_arrays(value: Any, arrays: dict[str, Any]) -> Any:
    if isinstance(value, np.ndarray):
        name = f"a{len(arrays)}"
        arrays[name] = value
        return {_ARRAY: name}
    if isinstance(value, Mapping):
        return {key: _without_arrays(item, arrays) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_without_arrays(item, arrays) for item in value]
    return value


def _with_arrays(value: Any, arrays: dict[str, Any]) -> Any:
    if isinstance(value, dict):
        if _ARRAY in value:
            return arrays[value[_ARRAY]]
        return {key: _with_arrays(item, arrays) for key, item in value.items()}
    if isinstance(value, list):
        return [_with_arrays(item, arrays) for item in value]
    return value
