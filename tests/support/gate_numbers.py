"""Every number that the gate goes by, to be held against `tests/golden/gate_numbers.json`.

A changed threshold, in a file or in code, has to be changed there too, on purpose:
`make numbers` (tests/support/gate_numbers.py) writes it.
"""

from __future__ import annotations

import dataclasses
import importlib
import json
import math
import pkgutil
from pathlib import Path
from typing import Any
from unittest import mock

import gate_trace
import numpy as np

import viskill_deploy.safety
from viskill_deploy.core import data
from viskill_deploy.core.description import load_cell
from viskill_deploy.safety import ceilings, envelope
from viskill_deploy.safety.envelope import CellEnvelope

GOLDEN = Path(__file__).resolve().parents[1] / "golden/gate_numbers.json"
PERIOD = 0.004


def plain(value: Any) -> Any:
    """A value as JSON knows it; numbers by their text, so that NaN and -0.0 are themselves."""
    if dataclasses.is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list | frozenset | np.ndarray):
        items = sorted(value) if isinstance(value, frozenset) else value
        return [plain(item) for item in items]
    if isinstance(value, float):
        # Twelve digits: the last ones of a sine may differ between machines.
        return f"{value:.12g}" if math.isfinite(value) else str(value)
    return value if isinstance(value, bool | int | str | None) else type(value).__name__


def thresholds(name: str) -> Any:
    """The thresholds of one shipped cell, as the gate and the grasp test have them."""
    cell = load_cell(name)
    return plain(
        {
            "envelope": CellEnvelope.of(cell, PERIOD),
            "grasp": cell.file.grasp.model_dump(),
        }
    )


def constants() -> dict[str, Any]:
    """Every number that stands in the gate's code under a name."""
    found = {}
    for module in pkgutil.walk_packages(viskill_deploy.safety.__path__, "viskill_deploy.safety."):
        for name, value in vars(importlib.import_module(module.name)).items():
            if name.isupper() and _is_numbers(value):
                found[f"{module.name.removeprefix('viskill_deploy.safety.')}.{name}"] = value
    return plain(found)


def checks(name: str) -> list[str]:
    """Every value of a shipped cell that is held against bounds: file, key, value and bounds."""
    found, check = list[str](), ceilings.check

    def noted(path: Path, key: str, *numbers: float) -> None:
        found.append(" ".join([path.name, key, *map(plain, map(float, numbers))]))
        check(path, key, *numbers)

    with mock.patch.object(envelope, "check", noted), mock.patch.object(ceilings, "check", noted):
        CellEnvelope.of(load_cell(name), PERIOD)
    return found


def _is_numbers(value: Any) -> bool:
    if isinstance(value, tuple):
        return bool(value) and all(map(_is_numbers, value))
    if isinstance(value, dict):
        return _is_numbers(tuple(value.values()))
    return isinstance(value, int | float)


def collect() -> dict[str, Any]:
    """All of it."""
    cells = data.names("robots/cells")
    return {
        "constants": constants(),
        "cells": {cell: thresholds(cell) for cell in cells},
        "checks": {cell: checks(cell) for cell in cells},
    }


def golden() -> dict[str, Any]:
    """What was agreed on."""
    return json.loads(GOLDEN.read_text(encoding="utf-8"))


if __name__ == "__main__":
    GOLDEN.write_text(json.dumps(collect(), indent=1, sort_keys=True) + "\n", encoding="utf-8")
    gate_trace.write()
    print(f"wrote {GOLDEN.name} and {gate_trace.GOLDEN.name}")
