"""What several tests share: a small bundle with untrained skills, and its task."""

import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import chaining
import pytest
import traceability
from untrained import write_untrained

from viskill_deploy.sim.tasks.base import load_task

UNMEASURED = {"property", "faults", "soak", "mutation"}
"""Coverage makes thousands of ticks take two and a half times as long, and what they cross, unit
tests have crossed."""


def pytest_itemcollected(item: pytest.Item) -> None:
    """A test that is named after an invariant carries its marker."""
    for invariant in traceability.ids_of_name(item.name):
        item.add_marker(pytest.mark.invariant(invariant))
    if UNMEASURED.intersection(item.path.parts):
        item.add_marker("no_cover")


@pytest.fixture(autouse=True)
def _unmeasured(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Neither what a test marked `no_cover` runs nor what it starts is measured."""
    if request.node.get_closest_marker("no_cover") is None:
        yield
        return
    for name in ("COVERAGE_PROCESS_START", "COVERAGE_PROCESS_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    here, threads = sys.gettrace(), threading.gettrace()
    sys.settrace(None)
    threading.settrace(None)  # type: ignore[arg-type]
    yield
    threading.settrace(threads)  # type: ignore[arg-type]
    sys.settrace(here)


@pytest.fixture
def chaining_bundle(untrained_bundle: Path) -> Path:
    """The same with a chaining policy and a value."""
    return chaining.make_chaining(untrained_bundle)


@pytest.fixture(scope="session")
def affinely_chained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A chaining bundle that does BiPegTransfer with known subgoals. Nobody changes it."""
    return chaining.affinely_chained(tmp_path_factory.mktemp("chained") / "bundle")


@pytest.fixture(scope="session")
def unchained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle that does BiPegTransfer under the scripted plan. Nobody changes it."""
    return chaining.unchained(tmp_path_factory.mktemp("unchained") / "bundle")


@pytest.fixture
def untrained_bundle(tmp_path: Path) -> Path:
    """A bundle whose skills keep still; correct in every other way."""
    return write_untrained(tmp_path / "untrained", load_task("bipegtransfer"))
