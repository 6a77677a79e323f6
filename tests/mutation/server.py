"""Collects the tests once, then tries each mutant in a fork of that process.

A mutant counts as killed when a test fails on it, or when it uses far more CPU time than the tests
need without it. A fork that dies in any other way is a failure of this harness and never a kill.
"""

from __future__ import annotations

import ast
import gc
import importlib
import os
import pickle
import random
import resource
import select
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import coverage
import pytest
from _pytest.runner import runtestprotocol
from hypothesis import Phase, settings

from tests.mutation import live
from tests.mutation.mutants import Mutant

ROOT = Path(__file__).resolve().parents[2]
SAFETY = ROOT / "viskill_deploy/safety"
TESTS = [
    "tests/unit/safety",
    *sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("tests/property/test_gate_*.py")),
    "tests/faults/test_gate_faults.py",
]
"""What is asked, as far as it reaches the gate."""
MEMORY = 6 << 30
WALL_FACTOR = 40.0
"""A fork that waits instead of computing is ended after this many times its CPU allowance."""

CONSTANTS = "test_gate_numbers.py::test_a_number_in_the_code"
"""What holds the numbers that stand in the code under a name."""

TRACE = "test_gate_trace.py::"
"""What holds everything that the gate says on a few walks: cheap, and likely to notice."""

CANARY = "safety/supervisor.py", "broken = self._ask(self._on_nothing)", "broken = []"


class HarnessError(Exception):
    """The result of this run could not be trusted."""


@dataclass
class Fork:
    """What came of one fork: `killed`, `survived`, `timeout` or `fresh` (needs a new process)."""

    status: str
    killer: str = ""
    tests: int = 0
    seconds: float = 0.0


@dataclass
class Baseline:
    """What each test covers and costs, measured without any mutant.

    Attributes:
        cost: CPU time by test, s.
        by_line: tests by (file relative to the package, line).
    """

    cost: dict[str, float] = field(default_factory=dict)
    by_line: dict[tuple[str, int], list[str]] = field(default_factory=dict)


class Server:
    """Runs the chosen tests on mutants, in forks.

    Args:
        session: pytest's session with everything collected and nothing run.
    """

    def __init__(self, session: pytest.Session) -> None:
        self.items = {item.nodeid: item for item in session.items}
        self.baseline = Baseline()
        self.killers: dict[str, list[str]] = defaultdict(list)
        """Tests that have killed mutants of a function, newest last."""

    def measure(self) -> None:
        """Runs every test once, and notes its cost and the lines of the gate that it reaches.

        Raises:
            HarnessError: a test fails without any mutant, or nothing reaches the gate.
        """
        result = _in_fork(self._measure_all, allowed_s=1800.0)
        if isinstance(result, Fork) or "failed" in result:
            raise HarnessError(f"the tests fail without any mutant: {result}")
        self.baseline = Baseline(result["cost"], result["by_line"])
        if not any(self.baseline.by_line.values()):
            raise HarnessError("no test reaches the gate")

    def _measure_all(self) -> dict[str, Any]:
        cover = coverage.Coverage(
            data_file=None, include=[f"{SAFETY}/*"], config_file=False, messages=False
        )
        cost: dict[str, float] = {}
        cover.start()
        for name, item in self.items.items():
            cover.switch_context(name)
            start = time.process_time()
            failed = _failure(item)
            cost[name] = time.process_time() - start
            if failed:
                return {"failed": f"{name}: {failed}"}
        cover.stop()
        data = cover.get_data()
        by_line: dict[tuple[str, int], list[str]] = {}
        for path in data.measured_files():
            file = str(Path(path).relative_to(ROOT / "viskill_deploy"))
            for line, names in data.contexts_by_lineno(path).items():
                by_line[file, line] = [name for name in names if name]
        return {"cost": cost, "by_line": by_line}

    def leave_out_dear_tests(self) -> None:
        """Keeps the tests that cost less than a third of a second."""
        cost = self.baseline.cost
        self.items = {name: item for name, item in self.items.items() if cost[name] < 0.3}
        for place, names in self.baseline.by_line.items():
            self.baseline.by_line[place] = [name for name in names if name in self.items]

    def tests_for(self, mutant: Mutant, hints: Sequence[str] = ()) -> list[str]:
        """Tests to ask, the likeliest first; all that reach the changed line."""
        lines = range(mutant.first_line, mutant.last_line + 1)
        reach = {t for line in lines for t in self.baseline.by_line.get((mutant.file, line), ())}
        if not reach:  # a constant of the module: whoever uses it, and whoever compares it
            reach = set(self.items)
            hints = [*hints, *(t for t in reach if CONSTANTS in t)]
        recent = list(dict.fromkeys(reversed(self.killers[mutant.function])))[:8]
        traces = [t for t in self.items if TRACE in t]
        first = [t for t in (*hints, *recent, *traces) if t in reach]
        return list(dict.fromkeys((*first, *_spread(sorted(reach), self.baseline.cost))))

    def try_mutant(
        self, mutant: Mutant, before: ast.Module, after: ast.Module, hints: Sequence[str] = ()
    ) -> Fork:
        """Runs the tests on one mutant.

        Raises:
            HarnessError: the fork ended in a way that says nothing about the mutant.
        """
        tests = self.tests_for(mutant, hints)
        allowed = 10.0 + 5.0 * sum(self.baseline.cost[name] for name in tests)

        def attempt() -> Fork:
            module = importlib.import_module(module_name(mutant.file))
            try:
                live.exchange(module, before, after)
            except live.NeedsFreshProcess:
                return Fork("fresh")
            except Exception as error:  # noqa: BLE001  the mutant cannot even be imported
                return Fork("killed", f"import: {type(error).__name__}")
            return self.ask(tests)

        start = time.perf_counter()
        outcome: Fork = _in_fork(attempt, allowed)
        if outcome.status == "fresh":
            outcome = in_fresh_process(mutant, after)
        outcome.seconds = time.perf_counter() - start
        if outcome.status == "killed" and outcome.killer in self.items:
            self.killers[mutant.function].append(outcome.killer)
        return outcome

    def ask(self, tests: Sequence[str]) -> Fork:
        """Runs tests until one fails."""
        for count, name in enumerate(tests, 1):
            if _failure(self.items[name]):
                return Fork("killed", name, count)
        return Fork("survived", tests=len(tests))

    def check_itself(self, rng: random.Random) -> None:
        """No change kills nothing, and a gate that asks no rule is found out.

        Raises:
            HarnessError: one of the two is not so.
        """
        some = rng.sample(sorted(self.items), min(60, len(self.items)))
        unchanged = _in_fork(lambda: self.ask(some), 120.0)
        if unchanged.status != "survived" or unchanged.tests != len(some):
            raise HarnessError(f"unchanged code is said to be {unchanged}")
        file, old, new = CANARY
        source = (ROOT / "viskill_deploy" / file).read_text(encoding="utf-8")
        if old not in source:
            raise HarnessError(f"the canary is gone: {old!r} is not in {file}")
        canary = Mutant("canary", file, 0, "", old, new, 0, 0, "canary")
        outcome = self.try_mutant(canary, ast.parse(source), ast.parse(source.replace(old, new)))
        if outcome.status != "killed":
            raise HarnessError(f"a gate that asks no rule is said to have {outcome.status}")

    def check_fresh_processes(self) -> None:
        """A new process, in which a module is put in place unchanged, fails no test.

        Raises:
            HarnessError: it does, or could not run the tests.
        """
        file = "safety/ceilings.py"
        source = (ROOT / "viskill_deploy" / file).read_text(encoding="utf-8")
        same = Mutant("unchanged", file, 0, "", "", "", 0, 0, "")
        outcome = in_fresh_process(same, ast.parse(source))
        if outcome.status != "survived":
            raise HarnessError(f"unchanged code is said to be {outcome} in a new process")


def module_name(file: str) -> str:
    """Name of the module in a file of the package."""
    return "viskill_deploy." + file.removesuffix(".py").replace("/", ".")


def _spread(tests: list[str], cost: dict[str, float]) -> list[str]:
    """One case of each cheap test first, then the next of each; the dear ones at the end."""
    groups: dict[str, list[str]] = defaultdict(list)
    for name in tests:
        groups[name.split("[")[0]].append(name)
    for cases in groups.values():
        random.Random(len(cases)).shuffle(cases)
    turns = [(k, name) for cases in groups.values() for k, name in enumerate(cases)]
    return [name for k, name in sorted(turns, key=lambda turn: (_class(cost[turn[1]]), turn))]


def _class(seconds: float) -> int:
    """Tests of about the same cost take turns."""
    return sum(seconds > bound for bound in (0.03, 0.3, 1.0, 3.0))


def _failure(item: pytest.Item) -> str:
    """Why a test does not pass; "" when it does. A skipped test is one that does not pass."""
    for report in runtestprotocol(item, log=False, nextitem=None):
        if not report.passed:
            return report.longreprtext[-400:] or report.outcome
    return ""


def _in_fork(work: Callable[[], Any], allowed_s: float) -> Any:
    """Runs `work` in a fork and returns its answer, or a `Fork("timeout")`.

    Raises:
        HarnessError: the fork died without an answer.
    """
    reader, writer = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.close(reader)
        status = 1
        try:
            _confine(allowed_s)
            answer = pickle.dumps(work())
            with os.fdopen(writer, "wb") as pipe:
                pipe.write(answer)
            status = 0
        finally:
            os._exit(status)
    os.close(writer)
    data, deadline = b"", time.monotonic() + WALL_FACTOR * allowed_s
    with os.fdopen(reader, "rb", buffering=0) as pipe:
        while select.select([pipe], [], [], max(deadline - time.monotonic(), 0.0))[0]:
            part = pipe.read(1 << 20)
            if not part:
                break
            data += part
        else:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
            return Fork("timeout", "wall clock")
    _, status = os.waitpid(pid, 0)
    if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU:
        return Fork("timeout", "CPU time")
    if status != 0 or not data:
        raise HarnessError(f"a fork ended with status {status} and {len(data)} bytes of answer")
    return pickle.loads(data)


def _confine(allowed_s: float) -> None:
    """Bounds on CPU time and memory; nothing on the terminal."""
    gc.disable()
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)
    resource.setrlimit(resource.RLIMIT_CPU, (int(allowed_s) + 1, int(allowed_s) + 30))
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def in_fresh_process(mutant: Mutant, after: ast.Module) -> Fork:
    """Tries a mutant that shows only at import: a new pytest that imports the changed source.

    Raises:
        HarnessError: pytest ended with anything but "all passed" or "a test failed".
    """
    environment = {
        **os.environ,
        "MUTATED_MODULE": module_name(mutant.file),
        "MUTATED_SOURCE": ast.unparse(after),
        "PYTHONPATH": str(ROOT),
    }
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "tests.mutation.import_hook"]
    command += ["-p", "no:cacheprovider", *TESTS]
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    last = done.stdout.strip().splitlines()[-4:]
    if done.returncode in (1, 2, 4):  # failed, or the tests could not even be imported
        failed = [line for line in last if line.startswith(("FAILED", "ERROR"))]
        return Fork("killed", (failed or last or ["import"])[0][:200])
    if done.returncode == 0:
        return Fork("survived")
    raise HarnessError(f"pytest ended with {done.returncode}: {last} {done.stderr[-400:]}")


class Collector:
    """The plugin that hands pytest's session to a piece of work instead of running the tests."""

    def __init__(self, work: Callable[[Server], int]) -> None:
        self._work = work
        self.exit_code = 3

    def pytest_configure(self) -> None:
        """Tests that draw numbers draw the same ones for every mutant."""
        settings.register_profile(
            "mutation",
            derandomize=True,
            database=None,
            deadline=None,
            phases=(Phase.explicit, Phase.generate),
        )
        settings.load_profile("mutation")

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Everything is collected: to work."""
        gc.collect()
        gc.freeze()
        self.exit_code = self._work(Server(session))
        return True


def serve(work: Callable[[Server], int]) -> int:
    """Collects the tests and runs `work` on them.

    Raises:
        HarnessError: pytest could not collect the tests.
    """
    collector = Collector(work)
    arguments = ["-q", "-q", "-s", "-p", "no:cacheprovider", "-o", "timeout=0"]
    code = pytest.main([*arguments, *(str(ROOT / test) for test in TESTS)], plugins=[collector])
    if code not in (0, 1):
        raise HarnessError(f"pytest could not collect the tests (exit {code})")
    return collector.exit_code
