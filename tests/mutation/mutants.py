"""Every small change of a source file that tests ought to notice.

Left alone, because no test of behaviour can or should tell: docstrings, annotations, imports,
`__slots__`, `slots=`, the `strict=` of a zip, and texts for people (strings with a space in them,
f-strings, anything inside a `raise`).
"""

from __future__ import annotations

import ast
import copy
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
ARITHMETIC: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.Pow: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
}
SWAPPED = {"min": "max", "max": "min", "any": "all", "all": "any", "cos": "sin", "sin": "cos"}
SKIPPED_KEYWORDS = {"strict", "slots"}
THRESHOLD_FACTORS = (0.95, 1.05, -1.0, 1e3, 1e-3)
"""A little stricter or looser, the other sign, and millimetres for metres or the reverse."""


@dataclass(frozen=True)
class Mutant:
    """One change.

    Attributes:
        id: the same in every run as long as the code around it is: file, function, kind, change.
        number: its place among all mutants of its file.
        first_line, last_line: of the statement that is changed.
    """

    id: str
    file: str
    number: int
    kind: str
    before: str
    after: str
    first_line: int
    last_line: int
    function: str


@dataclass
class _Place:
    statement: ast.stmt
    function: str
    in_code: bool
    """Inside a function; a number outside of one is a constant, mutated like a threshold."""
    in_raise: bool


Option = tuple[str, ast.AST]


def mutants_of(file: str, source: str) -> list[Mutant]:
    """All mutants of one file, in order."""
    walk = _Walk(-1)
    walk.visit(ast.parse(source))
    seen: Counter[str] = Counter()
    mutants = []
    for number, (kind, before, after, place) in enumerate(walk.found):
        stem = f"{file}:{place.function}:{kind}: {before} → {after}"
        seen[stem] += 1
        name = stem if seen[stem] == 1 else f"{stem} #{seen[stem]}"
        lines = _lines(place.statement)
        mutants.append(Mutant(name, file, number, kind, before, after, *lines, place.function))
    return mutants


def mutated(source: str, number: int) -> ast.Module:
    """The tree of a file with one of its mutants in place."""
    tree = _Walk(number).visit(ast.parse(source))
    return ast.fix_missing_locations(tree)


def _lines(statement: ast.stmt) -> tuple[int, int]:
    """Lines of a statement; of the head alone where it has a body."""
    body = getattr(statement, "body", None)
    if body:
        return statement.lineno, max(statement.lineno, body[0].lineno - 1)
    return statement.lineno, statement.end_lineno or statement.lineno


class _Walk(ast.NodeTransformer):
    """Goes through a tree in a fixed order, and puts the wanted mutant in."""

    def __init__(self, wanted: int) -> None:
        self.found: list[tuple[str, str, str, _Place]] = []
        self._wanted = wanted
        self._place = _Place(ast.Pass(), "", False, False)

    def visit(self, node: ast.AST) -> ast.AST:
        if _is_left_alone(node):
            return node
        outer = self._place
        self._place = _inner(node, outer)
        try:
            for kind, other in _options(node, self._place):
                if kind == "statement" and not self._place.in_code:
                    continue  # a name that is not there is found by anybody
                self.found.append((kind, _text(node), _text(other), self._place))
                if len(self.found) - 1 == self._wanted:
                    return ast.copy_location(other, node)
            return self.generic_visit(node)
        finally:
            self._place = outer

    def visit_parts(self, node: ast.AST, names: tuple[str, ...]) -> ast.AST:
        """Goes into some parts of a node only."""
        for name in names:
            part = getattr(node, name)
            if isinstance(part, list):
                part[:] = [self.visit(item) for item in part]
            elif part is not None:
                setattr(node, name, self.visit(part))
        return node

    def generic_visit(self, node: ast.AST) -> ast.AST:
        if isinstance(node, ast.AnnAssign):
            return self.visit_parts(node, ("value",))
        if isinstance(node, ast.FunctionDef):
            return self.visit_parts(node, ("args", "body"))
        if isinstance(node, ast.arguments):
            return self.visit_parts(node, ("defaults", "kw_defaults"))
        return super().generic_visit(node)


def _inner(node: ast.AST, outer: _Place) -> _Place:
    place = copy.copy(outer)
    if isinstance(node, ast.stmt):
        place.statement = node
        place.in_raise = isinstance(node, ast.Raise)
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        place.function = f"{outer.function}.{node.name}".lstrip(".")
    if isinstance(node, ast.FunctionDef):
        place.in_code = True
    return place


def _is_left_alone(node: ast.AST) -> bool:
    if isinstance(node, ast.Import | ast.ImportFrom | ast.JoinedStr):
        return True
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return True  # a docstring, or `...`
    if isinstance(node, ast.keyword) and node.arg in SKIPPED_KEYWORDS:
        return True
    return isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__slots__"


def _options(node: ast.AST, place: _Place) -> Iterator[Option]:
    if isinstance(node, ast.Compare):
        yield from _comparisons(node)
    elif isinstance(node, ast.BinOp) and type(node.op) in ARITHMETIC:
        yield "arithmetic", ast.BinOp(node.left, ARITHMETIC[type(node.op)](), node.right)
    elif isinstance(node, ast.AugAssign) and type(node.op) in ARITHMETIC:
        other = ast.AugAssign(node.target, ARITHMETIC[type(node.op)](), node.value)
        yield "arithmetic", other
        yield "statement", ast.Pass()
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
        yield "negation", node.operand
    elif isinstance(node, ast.BoolOp):
        other_op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        yield "boolean", ast.BoolOp(other_op, node.values)
        for index in range(len(node.values)):
            rest = [value for i, value in enumerate(node.values) if i != index]
            yield "condition", rest[0] if len(rest) == 1 else ast.BoolOp(node.op, rest)
    elif isinstance(node, ast.Constant):
        yield from _constants(node, place)
    elif isinstance(node, ast.Tuple) and not place.in_code and _is_pair(node):
        yield "threshold", ast.Tuple(node.elts[::-1], ast.Load())
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in SWAPPED:
        name = ast.Name(SWAPPED[node.func.id], ast.Load())
        yield "call", ast.Call(name, node.args, node.keywords)
    elif isinstance(node, ast.Name) and node.id == "abs":
        yield "call", ast.Name("float", ast.Load())
    else:
        yield from _statements(node)


def _comparisons(node: ast.Compare) -> Iterator[Option]:
    for index, op in enumerate(node.ops):
        for other in COMPARISONS[type(op)]:
            ops = [other() if i == index else old for i, old in enumerate(node.ops)]
            yield "comparison", ast.Compare(node.left, ops, node.comparators)


def _constants(node: ast.Constant, place: _Place) -> Iterator[Option]:
    value = node.value
    if isinstance(value, bool):
        yield "constant", ast.Constant(not value)
    elif isinstance(value, int):
        yield "constant", ast.Constant(value + 1)
        if not place.in_code:
            yield "constant", ast.Constant(value - 1)
    elif isinstance(value, float):
        if place.in_code:
            yield "constant", ast.Constant(1.05 * value or 1.0)
            if value:
                yield "constant", ast.Constant(0.0)
        else:
            others = [factor * value for factor in THRESHOLD_FACTORS] if value else [1.0]
            for other in [*others, 0.0] if value else others:
                yield "threshold", ast.Constant(other)
            yield "threshold", ast.Call(ast.Name("float", ast.Load()), [ast.Constant("nan")], [])
    elif isinstance(value, str) and " " not in value and not place.in_raise:
        yield "constant", ast.Constant("XX" + value)


def _is_pair(node: ast.Tuple) -> bool:
    """Two different numbers, such as a lower and an upper one, that could change places."""
    values = [item.value for item in node.elts if isinstance(item, ast.Constant)]
    numbers = [value for value in values if isinstance(value, float)]
    return len(node.elts) == len(numbers) == 2 and numbers[0] != numbers[1]


def _statements(node: ast.AST) -> Iterator[Option]:
    if isinstance(node, ast.If | ast.IfExp):
        other = copy.copy(node)
        other.test = ast.UnaryOp(ast.Not(), node.test)
        yield "condition", other
    elif isinstance(node, ast.While):
        yield "condition", ast.While(ast.Constant(False), node.body, node.orelse)
    elif isinstance(node, ast.comprehension) and node.ifs:
        yield "condition", ast.comprehension(node.target, node.iter, [], node.is_async)
    elif isinstance(node, ast.Return):
        if not isinstance(node.value, ast.Constant | None):
            yield "statement", ast.Return(ast.Constant(None))
    elif _is_deletable(node):
        yield "statement", ast.Pass()


def _is_deletable(node: ast.AST) -> bool:
    """A statement whose loss is not found at once by a name that is not there."""
    if isinstance(node, ast.Assign):
        return not isinstance(node.targets[0], ast.Name)
    return isinstance(node, ast.Expr | ast.Raise | ast.Continue | ast.Break)


def _text(node: ast.AST) -> str:
    """The changed part in one short line; of a long statement its head."""
    if isinstance(node, ast.comprehension):
        return ast.unparse(node).strip()
    if isinstance(node, ast.If | ast.While):
        return f"{type(node).__name__.lower()} {ast.unparse(node.test)}"
    return " ".join(ast.unparse(ast.fix_missing_locations(copy.deepcopy(node))).split())
