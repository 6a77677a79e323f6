"""Files of trials: a title, then a line of JSON a trial, so that a stopped study can go on."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from viskill_deploy.core.errors import CalibrationError


def read_lines(path: Path, title: dict[str, Any]) -> list[dict[str, Any]]:
    """Trials that are there already; begins the file where there is none.

    A last line that was cut off while it was written is taken away.

    Raises:
        CalibrationError: the file holds trials of something else.
    """
    wanted = json.dumps(title)
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(wanted + "\n", encoding="utf-8")
        return []
    text = path.read_text(encoding="utf-8")
    whole = text[: text.rfind("\n") + 1]
    first, *rest = whole.splitlines() or [""]
    if first != wanted:
        raise CalibrationError(
            f"{path}: holds trials of {first}, not {wanted}; name another folder or file"
        )
    if whole != text:
        path.write_text(whole, encoding="utf-8")
    return [json.loads(line) for line in rest]


def add_line(path: Path, row: dict[str, Any]) -> None:
    """Writes a trial, at once."""
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")
