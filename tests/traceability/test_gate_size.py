"""The gate can be read in an hour."""

import ast
from pathlib import Path

import pytest
from traceability import ROOT

SAFETY = ROOT / "viskill_deploy/safety"
FILES = sorted(SAFETY.rglob("*.py"))


def code_lines(path: Path) -> int:
    """Lines that are neither blank nor comment nor docstring."""
    text = path.read_text(encoding="utf-8")
    left_out: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            left_out |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return sum(
        bool(line.strip()) and not line.strip().startswith("#") and number not in left_out
        for number, line in enumerate(text.splitlines(), 1)
    )


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_rule_has_at_most_120_lines_of_code(path):
    if path.parent.name == "rules":
        assert code_lines(path) <= 120


def test_no_line_of_the_gate_is_left_out_of_the_coverage():
    assert not [path for path in FILES if "pragma" in path.read_text(encoding="utf-8")]
