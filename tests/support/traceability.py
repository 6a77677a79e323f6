"""Hazard → invariant → file → tests: read from data, the rules' folder and the tests themselves.

A test counts for an invariant when it is named after it (`test_s05_…`) or carries the marker
`@pytest.mark.invariant("S05")`; a file whose tests all do says so once, in `pytestmark`.

`python tests/support/traceability.py` writes docs/hazards.md.
"""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from viskill_deploy.observe.labels import RULES

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / "tests/traceability/hazards.toml"
DOCUMENT = ROOT / "docs/hazards.md"
IDS = tuple(f"S{number:02d}" for number in range(1, 35))
WORDS = {**RULES, "S33": "no needless stops", "S34": "rest after a stop"}
NAMED = re.compile(r"test_(s\d\d)_")

INTRODUCTION = """# Hazards

What can go wrong, the invariants that stand against it, the code that keeps each of them, and the
tests that would notice if it did not. `make hazards` writes this page from
`tests/traceability/hazards.toml`, the folder of rules and the tests' markers; a missing link fails
`tests/traceability/test_hazards.py`. What each invariant says, with thresholds and reasons, stands
in [safety.md](safety.md).

**What this is not.** A hazard analysis of a medical device. No severity, probability or residual
risk is claimed, and no conformity with any standard. Keep the hardware emergency stop within
reach, use phantoms, never patients.
"""


@dataclass(frozen=True)
class Hazard:
    """Something that can go wrong, and the ids of what stands against it."""

    id: str
    text: str
    invariants: tuple[str, ...]


def ids_of_name(name: str) -> tuple[str, ...]:
    """The invariant that a test is named after."""
    found = NAMED.match(name)
    return (found[1].upper(),) if found else ()


def hazards() -> list[Hazard]:
    """All hazards in the order of their file."""
    rows = tomllib.loads(DATA.read_text(encoding="utf-8"))["hazard"]
    return [Hazard(row["id"], row["text"], tuple(row["invariants"])) for row in rows]


def files_by_invariant() -> dict[str, list[str]]:
    """Files that keep each invariant: its rule, and what the data names."""
    rows = tomllib.loads(DATA.read_text(encoding="utf-8"))["invariant"]
    named = {row["id"]: list(row["files"]) for row in rows}
    folder = ROOT / "viskill_deploy/safety/rules"
    rules = {
        id_: [str(path.relative_to(ROOT)) for path in sorted(folder.glob(f"{id_.lower()}_*.py"))]
        for id_ in IDS
    }
    return {id_: rules[id_] + named.get(id_, []) for id_ in IDS}


def tests_by_invariant() -> dict[str, list[str]]:
    """Ids of the tests that count for each invariant, without their parameters."""
    found: dict[str, list[str]] = {id_: [] for id_ in IDS}
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        for name, ids in _tests_of(ast.parse(path.read_text(encoding="utf-8"))):
            for id_ in ids:
                found.setdefault(id_, []).append(f"{path.relative_to(ROOT)}::{name}")
    return found


def _tests_of(module: ast.Module) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Every test of a file with the ids that it counts for; a skipped test counts for nothing."""
    common = [
        id_
        for node in module.body
        if isinstance(node, ast.Assign) and _is_name(node.targets[0], "pytestmark")
        for id_ in _marked(node.value)
    ]
    for node in module.body:
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
            text = [ast.unparse(decorator) for decorator in node.decorator_list]
            if any(word in line for line in text for word in ("mark.skip", "mark.xfail")):
                continue
            own = [id_ for decorator in node.decorator_list for id_ in _marked(decorator)]
            yield node.name, tuple(dict.fromkeys((*ids_of_name(node.name), *own, *common)))


def _marked(node: ast.expr) -> list[str]:
    """Ids in every `pytest.mark.invariant(…)` inside an expression."""
    return [
        argument.value
        for call in ast.walk(node)
        if isinstance(call, ast.Call) and ast.unparse(call.func) == "pytest.mark.invariant"
        for argument in call.args
        if isinstance(argument, ast.Constant)
    ]


def _is_name(node: ast.expr, name: str) -> bool:
    return isinstance(node, ast.Name) and node.id == name


def page() -> str:
    """The text of docs/hazards.md."""
    files, tests = files_by_invariant(), tests_by_invariant()
    lines = [INTRODUCTION, "| hazard | what can go wrong | invariants |", "|---|---|---|"]
    lines += [
        f"| {hazard.id} | {hazard.text} | {', '.join(hazard.invariants)} |" for hazard in hazards()
    ]
    lines += ["", "| invariant | kept in | tested in |", "|---|---|---|"]
    for id_ in IDS:
        kept = ", ".join(f"`{Path(file).relative_to('viskill_deploy')}`" for file in files[id_])
        where = sorted({test.split("::")[0].removeprefix("tests/") for test in tests[id_]})
        tested = ", ".join(f"`{file}`" for file in where)
        lines.append(f"| {WORDS[id_]} ({id_}) | {kept or '—'} | {tested or '—'} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    DOCUMENT.write_text(page(), encoding="utf-8")
    print(f"wrote {DOCUMENT.relative_to(ROOT)}")
