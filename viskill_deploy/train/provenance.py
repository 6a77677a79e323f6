"""Which code ran."""

from __future__ import annotations

import functools
import subprocess
from pathlib import Path

from viskill_deploy.core.data import PACKAGE


@functools.cache
def running_commit() -> str | None:
    """`commit` of the code that this process runs: as it was when first asked for."""
    return commit()


def commit(package: Path = PACKAGE) -> str | None:
    """The commit that a package's code is of.

    Args:
        package: its folder; `robots` beside it counts, too, since what is learned in is made of it.

    Returns:
        The hash, with `+` behind it if code or robots were changed since; None where the package is
        not under version control, as in an installed wheel.
    """

    def git(*question: str) -> str:
        command = ("git", "-C", str(package), *question)
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", "__init__.py")  # a venv may lie in somebody's checkout
        head = git("rev-parse", "HEAD")
        changed = git("status", "--porcelain", "--", ".", "../robots")
    except (OSError, subprocess.CalledProcessError):
        return None
    return head + "+" * bool(changed)
