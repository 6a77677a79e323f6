"""Files that are written once, and never over another."""

from __future__ import annotations

from pathlib import Path

from viskill_deploy.core.errors import RecordingError


def new_file(path: Path) -> Path:
    """The path itself, its folder made, if nothing is there.

    Raises:
        RecordingError: something is there, or the folder cannot be made.
    """
    if path.exists() or path.is_symlink():
        raise RecordingError(f"{path}: exists; name a new file, or take that one away")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecordingError(f"{path.parent}: cannot be made ({error}); name another") from error
    return path
