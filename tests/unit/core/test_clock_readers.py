"""S21: the date is nothing to control by. A clock that is set leaves a run as it is."""

import ast
import itertools
import time
from pathlib import Path

import pytest

import viskill_deploy
from viskill_deploy.core.clock import MonotonicClock, SteppedClock

PACKAGE = Path(viskill_deploy.__file__).parent
CONTROL = ("core", "safety", "motion", "kinematics", "bundle", "sim", "drivers", "runtime")
FILES = sorted(
    path.relative_to(PACKAGE)
    for folder in CONTROL
    for path in (PACKAGE / folder).rglob("*.py")
    if path.relative_to(PACKAGE) != Path("core/clock.py")
)
DATES = {"wall_time", "datetime", "time"}


def imported(path: Path) -> set[str]:
    """Names of all modules that a file imports, and of what it takes from core.clock."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
            names |= {alias.name for alias in node.names if node.module.endswith("core.clock")}
    return names


@pytest.mark.parametrize("path", FILES, ids=str)
def test_s21_no_control_code_reads_the_date_or_the_time_but_through_its_clock(path):
    assert not imported(PACKAGE / path) & DATES


@pytest.mark.parametrize("jump_s", [3600.0, -3600.0, 86400.0, -86400.0])
def test_s21_a_date_that_is_set_moves_no_clock_of_ours(monkeypatch, jump_s):
    monotonic, stepped = MonotonicClock(), SteppedClock()
    before = monotonic.now()
    date = time.time()
    dates = (date + jump_s * n for n in itertools.count())
    monkeypatch.setattr(time, "time", lambda: next(dates))
    assert 0.0 <= monotonic.now() - before < 60.0
    assert before + 0.001 <= monotonic.sleep_until(before + 0.001) < before + 60.0
    assert stepped.sleep_until(stepped.now() + 0.5) == stepped.now()
