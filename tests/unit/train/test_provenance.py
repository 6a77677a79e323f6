import subprocess
from pathlib import Path

import pytest

from viskill_deploy.train.provenance import commit


def git(folder: Path, *words: str) -> str:
    who = ("-c", "user.name=a", "-c", "user.email=a@b.c")
    done = subprocess.run(
        ["git", "-C", str(folder), *who, *words], check=True, capture_output=True, text=True
    )
    return done.stdout.strip()


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A checkout with a package, robots and a document."""
    for name in ("package/__init__.py", "robots/arm.toml", "docs/page.md"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).touch()
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "first")
    return tmp_path / "package"


def test_the_commit_is_the_checkouts(package: Path) -> None:
    assert commit(package) == git(package, "rev-parse", "HEAD")
    (package.parent / "docs" / "page.md").write_text("new")
    assert not str(commit(package)).endswith("+")


@pytest.mark.parametrize("name", ["package/__init__.py", "package/new.py", "robots/arm.toml"])
def test_changed_code_and_robots_are_told(name: str, package: Path) -> None:
    (package.parent / name).write_text("x = 1")
    assert str(commit(package)).endswith("+")


def test_what_lies_in_a_foreign_checkout_has_none(package: Path) -> None:
    installed = package.parent / "venv" / "package"
    installed.mkdir(parents=True)
    (installed / "__init__.py").touch()
    assert commit(installed) is None
    assert commit(package.parent / "nowhere") is None
