"""The finder of data files: robots, policies, calibration."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from pathlib import Path

import platformdirs

from viskill_deploy.core.errors import DataFileError

PACKAGE = Path(__file__).resolve().parents[1]


def data_roots() -> tuple[Path, ...]:
    """Folders that may hold `robots/`, `policies/`, `calibration/`, first match wins.

    In order: `$VISKILL_DATA`, the user's data folder, the copy inside the package (a wheel), the
    checkout (an editable install).
    """
    return (*own_roots(), *packaged_roots())


def own_roots() -> tuple[Path, ...]:
    """The roots for files of one's own, which may not be there yet."""
    roots = [Path(os.environ["VISKILL_DATA"])] if os.environ.get("VISKILL_DATA") else []
    return (*roots, Path(platformdirs.user_data_dir("viskill_deploy")))


def packaged_roots() -> tuple[Path, ...]:
    """The roots that come with the package."""
    return (PACKAGE / "_data", PACKAGE.parent)


def find(relative: str) -> Path:
    """Path of a data file or folder such as `robots/psm_classic.toml`.

    Raises:
        DataFileError: no root holds it; names the roots that were searched.
    """
    for root in data_roots():
        if (root / relative).exists():
            return root / relative
    searched = ", ".join(str(root) for root in data_roots())
    raise DataFileError(relative, "", f"not found; searched {searched}")


def names(folder: str) -> list[str]:
    """Stems of every TOML file under `folder` in any root, sorted."""
    return sorted({p.stem for root in data_roots() for p in (root / folder).glob("*.toml")})


def shadows(path: Path) -> Path | None:
    """The packaged file that `path` stands in front of, or None."""
    for root in data_roots():
        try:
            relative = path.relative_to(root)
        except ValueError:
            continue
        for packaged in packaged_roots():
            if packaged != root and (packaged / relative).is_file():
                return packaged / relative
        return None
    return None


def digests(paths: Iterable[Path]) -> tuple[tuple[str, str], ...]:
    """Path and hex SHA-256 of files, as preflight, results and recordings name them."""
    return tuple((str(path), sha256(path)) for path in paths)


def sha256(path: Path) -> str:
    """Hex SHA-256 of a file's bytes."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
