"""Mutation testing of the safety gate: `make mutation`.

Changes one thing at a time in `viskill_deploy/safety` and asks the tests whether they notice.
Resumable: every outcome is a line of `build/mutation/results.jsonl`, and counts as long as gate,
tests and thresholds are the same bytes. Ends with an error unless every mutant was tried and every
survivor stands in `allowed.toml` with the reason why nobody could notice it.

    python tests/mutation/run.py                    # everything
    python tests/mutation/run.py --seeded           # the 25 seeded bugs
    python tests/mutation/run.py --sample 60        # a random part
    python tests/mutation/run.py --only s05         # files and functions whose name holds this
    python tests/mutation/run.py --quick            # a first look, without the tests that are dear

Exit codes: 0 nothing survives but what is allowed, 1 something does, 2 not everything was tried,
3 the harness itself is broken.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import multiprocessing
import os
import random
import sys
import time
import tomllib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
os.environ.setdefault("OMP_NUM_THREADS", "1")

from tests.mutation.mutants import Mutant, mutants_of, mutated
from tests.mutation.server import ROOT, SAFETY, TESTS, HarnessError, Server, serve

OUTPUT = ROOT / "build/mutation"
RESULTS = OUTPUT / "results.jsonl"
HERE = Path(__file__).parent
AT_MOST = 5
"""Survivors that may be allowed, each proven to change nothing."""
CHECK_EVERY = 200
KILLED = ("killed", "timeout")
SURVIVED_EXIT, INCOMPLETE_EXIT, BROKEN_EXIT = 1, 2, 3


@dataclass(frozen=True)
class Case:
    """A mutant with its file's text and the tree that it makes of it."""

    mutant: Mutant
    source: str
    replaced: tuple[str, str] | None = None
    """What a seeded bug replaces by what; None for a mutant by rule."""

    def trees(self) -> tuple[ast.Module, ast.Module]:
        """The file as it is, and as it is changed."""
        before = ast.parse(self.source)
        if self.replaced is None:
            return before, mutated(self.source, self.mutant.number)
        return before, ast.parse(self.source.replace(*self.replaced))


def generated() -> list[Case]:
    """Every mutant of every file of the gate."""
    cases = []
    for path in sorted(SAFETY.rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        file = str(path.relative_to(ROOT / "viskill_deploy"))
        cases += [Case(mutant, source) for mutant in mutants_of(file, source)]
    return cases


def seeded() -> list[Case]:
    """The bugs of seeded.toml.

    Raises:
        HarnessError: a bug no longer fits its file; adapt it.
    """
    cases = []
    for bug in tomllib.loads((HERE / "seeded.toml").read_text(encoding="utf-8"))["bug"]:
        path = ROOT / "viskill_deploy" / bug["file"]
        source, old = path.read_text(encoding="utf-8"), bug["find"]
        if source.count(old) != 1 or old == bug["replace"]:
            raise HarnessError(f"{bug['name']!r} does not fit {bug['file']}; adapt seeded.toml")
        first = source[: source.index(old)].count("\n") + 1
        last = first + old.strip("\n").count("\n")
        name = f"seeded: {bug['name']}"
        mutant = Mutant(
            name, bug["file"], 0, "seeded", old, bug["replace"], first, last, bug["file"]
        )
        cases.append(Case(mutant, source, (old, bug["replace"])))
    return cases


def fingerprint() -> str:
    """One hash of everything that an outcome depends on."""
    digest = hashlib.sha256()
    folders = [ROOT / "viskill_deploy", ROOT / "robots", ROOT / "tests/support", HERE]
    paths = {p for folder in folders for p in folder.rglob("*") if p.suffix in (".py", ".toml")}
    for test in TESTS:
        paths |= set((ROOT / test).rglob("*.py")) if (ROOT / test).is_dir() else {ROOT / test}
    for path in sorted(paths | {ROOT / "tests/conftest.py", ROOT / "pyproject.toml"}):
        if path.name != "allowed.toml":
            digest.update(f"{path.relative_to(ROOT)}\0".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def read_results() -> Iterator[dict[str, str]]:
    """Earlier outcomes; a line that was cut off by a kill is not one."""
    if RESULTS.exists():
        for line in RESULTS.read_text(encoding="utf-8").splitlines():
            try:
                yield json.loads(line)
            except json.JSONDecodeError:
                continue


def work(server: Server, cases: list[Case], key: str, options: argparse.Namespace) -> int:
    """Measures the baseline once, then shares the cases between workers."""
    start = time.monotonic()
    server.measure()
    if options.quick:
        server.leave_out_dear_tests()
    server.check_itself(random.Random(0))
    if not options.quick:
        server.check_fresh_processes()
    print(
        f"{len(cases)} mutants to try against {len(server.items)} tests; the tests pass without "
        f"any, in {sum(server.baseline.cost.values()):.0f} s of CPU time",
        flush=True,
    )
    hints: dict[str, list[str]] = {}
    for row in read_results():
        if row["status"] == "killed":
            hints.setdefault(row["id"], []).insert(0, row["killer"])
    deadline = start + 60.0 * options.minutes
    context = multiprocessing.get_context("fork")
    place, lock = context.Value("q", 0), context.Lock()
    workers = [
        context.Process(target=_worker, args=(server, cases, key, hints, place, lock, deadline))
        for _ in range(options.workers)
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    if any(worker.exitcode != 0 for worker in workers):
        raise HarnessError("a worker died; the outcomes up to there are kept")
    print(f"took {(time.monotonic() - start) / 60.0:.1f} minutes", flush=True)
    return 0


def _worker(server, cases, key, hints, place, lock, deadline):  # type: ignore[no-untyped-def]
    code, rng = BROKEN_EXIT, random.Random(os.getpid())
    try:
        count = 0
        while time.monotonic() < deadline:
            with place.get_lock():
                index = place.value
                place.value += 1
            if index >= len(cases):
                break
            mutant = cases[index].mutant
            outcome = server.try_mutant(mutant, *cases[index].trees(), hints.get(mutant.id, ()))
            row = {"key": key, "id": mutant.id, "line": mutant.first_line, **vars(outcome)}
            with lock, RESULTS.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row, ensure_ascii=False) + "\n")
            if outcome.status == "survived":
                print(f"survived: {mutant.id} (line {mutant.first_line})", flush=True)
            count += 1
            if count % CHECK_EVERY == 0:
                server.check_itself(rng)
                print(f"{index + 1} of {len(cases)} tried", flush=True)
        code = 0
    except HarnessError as error:
        print(f"the harness is broken: {error}", flush=True)
    finally:
        sys.stdout.flush()
        os._exit(code)


def verdict(cases: list[Case], key: str, is_everything: bool) -> int:
    """Prints what came of all cases; the exit code says whether that is good."""
    names = {case.mutant.id for case in cases}
    done = {row["id"]: row for row in read_results() if row["key"] == key and row["id"] in names}
    count = Counter(row["status"] for row in done.values())
    kinds = Counter(case.mutant.kind for case in cases)
    print(f"mutants: {len(cases)} ({', '.join(f'{k} {n}' for k, n in kinds.most_common())})")
    print(f"tried: {len(done)}; {', '.join(f'{s} {n}' for s, n in sorted(count.items()))}")
    spent = sum(float(row["seconds"]) for row in done.values())
    print(f"time in mutants: {spent / 60.0:.1f} minutes of one core")
    rows = tomllib.loads((HERE / "allowed.toml").read_text(encoding="utf-8")).get("equivalent", [])
    allowed = {row["id"]: row["proof"] for row in rows}
    survivors = sorted(name for name, row in done.items() if row["status"] not in KILLED)
    bad = [name for name in survivors if name not in allowed]
    for name in survivors:
        print(f"  survived: {name} (line {done[name]['line']}): {allowed.get(name, 'NOT ALLOWED')}")
    stale = [name for name in allowed if name not in survivors] if is_everything else []
    for name in stale:
        print(f"  allowed, but killed or gone; take it out of allowed.toml: {name}")
    if len(done) < len(cases):
        print(f"{len(cases) - len(done)} mutants were not tried; run the same command again")
        return INCOMPLETE_EXIT
    if len(allowed) > AT_MOST or not all(proof.strip() for proof in allowed.values()):
        print(f"allowed.toml may hold {AT_MOST} survivors, each with its proof")
        return SURVIVED_EXIT
    return SURVIVED_EXIT if bad or stale else 0


def chosen(options: argparse.Namespace) -> list[Case]:
    """The cases that the options ask for.

    Raises:
        HarnessError: there is none.
    """
    cases = seeded() if options.seeded else generated()
    if options.only:
        cases = [c for c in cases if options.only in c.mutant.id]
    if options.sample:
        cases = random.Random(options.seed).sample(cases, min(options.sample, len(cases)))
    if not cases:
        raise HarnessError("there is no mutant to try")
    return cases


def main() -> int:
    """Runs the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeded", action="store_true", help="the seeded bugs, not the rules")
    parser.add_argument("--only", default="", help="mutants whose id holds this")
    parser.add_argument("--sample", type=int, default=0, help="so many, drawn at random")
    parser.add_argument("--quick", action="store_true", help="cheap tests only; a first look")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--minutes", type=float, default=60.0, help="stop after this long")
    options = parser.parse_args()
    OUTPUT.mkdir(parents=True, exist_ok=True)
    try:
        cases, key = chosen(options), fingerprint() + "-quick" * options.quick
        is_everything = not (options.seeded or options.only or options.sample)
        done = {row["id"] for row in read_results() if row["key"] == key}
        killed = {row["id"] for row in read_results() if row["status"] in KILLED}
        left = [case for case in cases if case.mutant.id not in done]
        left.sort(key=lambda case: case.mutant.id in killed)  # what is not sure to be found, first
        if left:
            serve(lambda server: work(server, left, key, options))
        if fingerprint() != key.removesuffix("-quick"):
            raise HarnessError("files were changed while the mutants ran; run it again")
        return verdict(cases, key, is_everything)
    except HarnessError as error:
        print(f"the harness is broken: {error}")
        return BROKEN_EXIT


if __name__ == "__main__":
    sys.exit(main())
