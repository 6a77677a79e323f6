"""The tool that tests the tests: what it changes, and that it cannot pass without testing."""

import ast
import types

import pytest
from hypothesis import given
from hypothesis import strategies as st

import tests.mutation.run as tool
from tests.mutation import live, mutants, server

SOURCE = '''
"""Text."""
from math import inf
LIMIT = 2.0
class Rule:
    """Text."""
    id = "S99"
    def judge(self, x: int = 3) -> bool:
        """Text."""
        for a, b in zip((1,), (2,), strict=True):
            if a < b and not x == LIMIT:
                self.y[0] = max(x, 1.5)
                raise ValueError("text" + "word")
        return x - 2 >= 0
'''


def made() -> types.ModuleType:
    module = types.ModuleType("made_for_mutation")
    module.__file__ = "made.py"
    exec(compile(SOURCE, "made.py", "exec"), module.__dict__)
    return module


def test_every_kind_of_change_is_made_and_texts_are_left_alone():
    found = mutants.mutants_of("made.py", SOURCE)
    assert {m.kind for m in found} == {
        "comparison", "arithmetic", "negation", "boolean", "condition", "constant", "call",
        "statement", "threshold",
    }  # fmt: skip
    changes = {(m.before, m.after) for m in found}
    assert {("a < b", "a <= b"), ("a < b", "a >= b"), ("x - 2", "x + 2")} <= changes
    assert ("max(x, 1.5)", "min(x, 1.5)") in changes
    assert ("2.0", "1.9") in changes
    assert ("2.0", "float('nan')") in changes
    assert not [m for m in found if "Text" in m.before or m.before in ("True", "'word'", "'text'")]
    assert len({m.id for m in found}) == len(found)


def test_each_mutant_differs_from_the_source_and_from_every_other():
    found = mutants.mutants_of("made.py", SOURCE)
    texts = {ast.unparse(mutants.mutated(SOURCE, m.number)) for m in found}
    assert len(texts) == len(found)
    assert ast.unparse(ast.parse(SOURCE)) not in texts


@pytest.mark.parametrize(
    ("old", "new", "look"),
    [
        ("x - 2 >= 0", "x - 2 > 0", lambda m: m.Rule().judge(2) is False),
        ("LIMIT = 2.0", "LIMIT = 3.0", lambda m: m.LIMIT == 3.0),
        ('id = "S99"', 'id = "S98"', lambda m: m.Rule.id == "S98"),
        ("x: int = 3", "x: int = 4", lambda m: m.Rule.judge.__defaults__ == (4,)),
    ],
)
def test_a_change_reaches_what_is_already_imported(old, new, look):
    module = made()
    assert not look(module)
    live.exchange(module, ast.parse(SOURCE), ast.parse(SOURCE.replace(old, new)))
    assert look(module)


def test_what_cannot_be_exchanged_is_said_so():
    module, after = made(), SOURCE.replace("class Rule:", "class Rule(dict):")
    for other in (SOURCE, after):
        with pytest.raises(live.NeedsFreshProcess):
            live.exchange(module, ast.parse(SOURCE), ast.parse(other))


def test_every_seeded_bug_fits_and_there_are_25():
    cases = tool.seeded()
    assert len(cases) == 25
    for case in cases:
        before, after = map(ast.unparse, case.trees())
        assert before != after


def test_every_file_of_the_gate_has_mutants_of_most_kinds():
    cases = tool.generated()
    files = {case.mutant.file for case in cases}
    expected = {p for p in server.SAFETY.rglob("*.py") if p.name != "__init__.py"}
    assert files >= {str(p.relative_to(tool.ROOT / "viskill_deploy")) for p in expected}
    assert len(cases) > 2000


def test_a_fork_that_dies_or_hangs_is_no_kill():
    with pytest.raises(server.HarnessError, match="ended with status"):
        server._in_fork(lambda: server.os._exit(0), 10.0)
    with pytest.raises(server.HarnessError, match="ended with status"):
        server._in_fork(lambda: server.os.kill(server.os.getpid(), 9), 10.0)
    with pytest.raises(server.HarnessError, match="ended with status"):
        server._in_fork(lambda: 1 / 0, 10.0)
    assert server._in_fork(lambda: 7, 10.0) == 7


def test_a_fork_that_computes_for_ever_is_a_timeout():
    def forever() -> None:
        while True:
            pass

    assert server._in_fork(forever, 0.0).status == "timeout"


@given(st.lists(st.sampled_from("abc"), min_size=1, max_size=30))
def test_no_test_is_lost_when_they_are_put_in_order(letters):
    names = [f"{letter}[{index}]" for index, letter in enumerate(letters)]
    cost = {name: 0.01 * (index % 5) for index, name in enumerate(names)}
    assert sorted(server._spread(names, cost)) == sorted(names)


class Options:
    seeded, only, sample, seed = False, "no such mutant", 0, 0


def test_no_mutant_at_all_is_an_error():
    with pytest.raises(server.HarnessError, match="no mutant"):
        tool.chosen(Options)


@pytest.mark.parametrize(
    ("rows", "allowed", "code"),
    [
        ([("a", "killed"), ("b", "timeout")], "", 0),
        ([("a", "killed")], "", 2),
        ([("a", "killed"), ("b", "survived")], "", 1),
        ([("a", "killed"), ("b", "survived")], '[[equivalent]]\nid = "b"\nproof = "p"', 0),
        ([("a", "killed"), ("b", "survived")], '[[equivalent]]\nid = "b"\nproof = " "', 1),
        ([("a", "killed"), ("b", "killed")], '[[equivalent]]\nid = "b"\nproof = "p"', 1),
        ([("a", "killed"), ("b", "killed", "another tree")], "", 2),
    ],
)
def test_the_verdict_is_good_only_when_all_was_tried_and_nothing_unproven_survives(
    rows, allowed, code, tmp_path, monkeypatch
):
    monkeypatch.setattr(tool, "RESULTS", tmp_path / "results.jsonl")
    monkeypatch.setattr(tool, "HERE", tmp_path)
    (tmp_path / "allowed.toml").write_text(allowed, encoding="utf-8")
    lines = [
        tool.json.dumps(
            {"key": (*row, "k")[2], "id": row[0], "status": row[1], "seconds": 0, "line": 1}
        )
        for row in rows
    ]
    tool.RESULTS.write_text("\n".join(lines) + '\n{"key": "k", "id', encoding="utf-8")
    cases = [
        tool.Case(mutants.Mutant(name, "f.py", 0, "call", "x", "y", 1, 1, ""), "") for name in "ab"
    ]
    assert tool.verdict(cases, "k", is_everything=True) == code
