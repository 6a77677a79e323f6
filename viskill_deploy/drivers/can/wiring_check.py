"""The note that a table of axes has been tried on its arms with small motions, one axis at a time.

It holds for these very drives and instruments: whatever changes in the file, or in an instrument's
coupling, asks for the small motions again. Real arms are not connected for a run without it.
"""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

import platformdirs

from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.sealed import read_sealed, sealed
from viskill_deploy.drivers.can.config import CanFile

LARGEST_BYTES = 4096
KIND = "small motions of every axis"


def note_checked(cell: CellDescription, file: CanFile, stamp: str) -> Path:
    """Keeps the note; returns its path.

    Args:
        cell: the arms with their instruments.
        file: the drives as they were tried.
        stamp: when, for people.
    """
    path = _path(cell, file)
    path.parent.mkdir(parents=True, exist_ok=True)
    content = {"kind": KIND, "file": file.name, "wiring": _wiring(cell, file), "when": stamp}
    path.write_text(sealed(content), encoding="utf-8")
    return path


def demand_checked(cell: CellDescription, file: CanFile) -> None:
    """Raises DriverError unless these drives and instruments have been tried."""
    try:
        note = read_sealed(_path(cell, file), LARGEST_BYTES)
    except (OSError, ValueError) as error:
        raise DriverError(
            f"the axes of CAN file {file.name} have not been tried with these instruments since it "
            f"was changed; run `viskill can check {file.name}` at the arms first"
        ) from error
    if note.get("kind") != KIND or note.get("wiring") != _wiring(cell, file):
        raise DriverError(
            f"{_path(cell, file)} is not about CAN file {file.name}; delete it and run "
            "`viskill can check` again"
        )


def _wiring(cell: CellDescription, file: CanFile) -> str:
    """Digest of all that lies between a joint and its drive."""
    couplings = [[arm.name, arm.arm.tool, arm.arm.actuator_to_joint.tolist()] for arm in cell.arms]
    said = json.dumps([file.model_dump(mode="json", by_alias=True), couplings], sort_keys=True)
    return hashlib.sha256(said.encode()).hexdigest()


def _path(cell: CellDescription, file: CanFile) -> Path:
    """Of the note: `$VISKILL_STATE/can`, or the user's state folder."""
    root = os.environ.get("VISKILL_STATE") or platformdirs.user_state_dir("viskill_deploy")
    return Path(root) / "can" / f"{_wiring(cell, file)[:32]}.json"
