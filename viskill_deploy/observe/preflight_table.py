"""The preflight as people read it: a table on a terminal, plain lines elsewhere."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from rich.console import Console
from rich.table import Table
from rich.text import Text

from viskill_deploy.observe.labels import rule_label, with_labels
from viskill_deploy.runtime.checklist import Line

MARKS = {"pass": "✓", "warn": "!", "fail": "✗"}
STYLES = {"pass": "green", "warn": "yellow", "fail": "red"}

FAR = 0.9995
"""Margins from here on are "far away" and share a line."""


def print_preflight(
    title: str, lines: Sequence[Line], files: Iterable[tuple[str, str]], console: Console
) -> None:
    """Prints the lines of a preflight, then the files as `sha256sum` does."""
    if console.is_terminal:
        table = Table(title=Text(title), title_justify="left", box=None, pad_edge=False)
        table.add_column("")
        table.add_column("what", style="bold", no_wrap=True)
        table.add_column("margin", justify="right", no_wrap=True)
        table.add_column("found")
        for line in shown(lines):
            style = STYLES[line.status] if line.status != "pass" else ""
            mark = f"[{STYLES[line.status]}]{MARKS[line.status]}[/]"
            told = map(Text, (label(line), percent(line.margin), found(line)))
            table.add_row(mark, *told, style=style)
        console.print(table)
    else:
        console.print(title, markup=False, highlight=False, soft_wrap=True)
        for line in shown(lines):
            parts = [text for text in (percent(line.margin), found(line)) if text]
            text = f"{line.status}  {label(line)}: {', '.join(parts)}"
            console.print(text, markup=False, highlight=False, soft_wrap=True)
    for path, digest in files:
        console.print(f"{digest}  {path}", markup=False, highlight=False, soft_wrap=True)


def shown(lines: Iterable[Line]) -> Iterator[Line]:
    """The lines, those of rules that the plan stays far away from as one."""
    far = []
    for line in lines:
        if _is_rule(line) and line.margin is not None and line.margin >= FAR:
            far.append(rule_label(line.rule))
        else:
            yield line
    if far:
        yield Line("  far from the limits of", "", "pass", None, ", ".join(sorted(far)))


def label(line: Line) -> str:
    """What a line is about, such as "bundle (S28)"; the rules of the plan are indented."""
    if _is_rule(line):
        return f"  {rule_label(line.rule)}"
    return f"{line.name} ({line.rule})" if line.rule else line.name


def found(line: Line) -> str:
    """What was found, every rule by its name."""
    return with_labels(line.text)


def percent(margin: float | None) -> str:
    """What was left of the limit; "" where there is no number."""
    if margin is None:
        return ""
    return f"{100 * margin:.1f} %" if margin >= 0.0 else "over the limit"


def summary(lines: Sequence[Line]) -> str:
    """How many looks were good, in one sentence."""
    failed = [line for line in lines if line.status == "fail"]
    warned = sum(line.status == "warn" for line in lines)
    if failed:
        return f"{len(failed)} of {len(lines)} checks failed: the cell would not be armed"
    rest = f", {warned} with a warning" if warned else ""
    return f"all {len(lines)} checks passed{rest}: the cell may be armed"


def _is_rule(line: Line) -> bool:
    return line.name == "plan" and bool(line.rule)
