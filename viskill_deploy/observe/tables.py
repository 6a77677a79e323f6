"""What the terminal shows: a progress bar during a run, tables at its end.

On something that is not a terminal, plain lines without colours or boxes.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from viskill_deploy.observe.faults import struck_rows
from viskill_deploy.observe.starts import Result
from viskill_deploy.observe.summary import MarginRow, SkillRow, facts, margin_rows, skill_rows

TIGHT = 0.25
"""Margins below this are shown each for itself; the report shows all."""


class Advance(Protocol):
    """Tells the progress display that one more episode is over."""

    def __call__(self, successes: int) -> None:
        """Moves on by one; `successes` so far stands beside the bar."""
        ...


def print_tables(result: Result, console: Console) -> None:
    """Prints what a run came to: its figures, its skills, its margins."""
    if not console.is_terminal:
        for line in plain_lines(result):
            console.print(line, markup=False, highlight=False, soft_wrap=True)
        return
    console.print(_fact_table(result))
    if skill_rows(result):
        console.print(_skill_table(result))
    if margin_rows(result):
        console.print(_margin_table(result))
    if struck_rows(result):
        console.print(_fault_table(result))
    for note in result.get("notes") or ():
        console.print(f"note: {note}", markup=False, style="yellow")


def plain_lines(result: Result) -> Iterator[str]:
    """The same as lines of text."""
    yield _title(result)
    for fact in facts(result):
        yield f"{fact.name.lower()}: {fact.text}"
    for skill in skill_rows(result):
        yield _skill_line(skill)
    tight, others = _tight(result)
    for margin in tight:
        where = f" at {margin.where}" if margin.where else ""
        yield f"smallest margin to {margin.label}: {margin.text}{where}"
    if others:
        yield f"smallest margin to {others}"
    for row in struck_rows(result):
        yield f"fault {row.fault}: {row.what}; declared: {row.declared}; seen: {row.seen}"
    for note in result.get("notes") or ():
        yield f"note: {note}"


def _skill_line(skill: SkillRow) -> str:
    source = f", subgoal {skill.source}" if skill.source else ""
    value = f", value {skill.value}" if skill.values else ""
    low = f", {skill.values_low} below the threshold" if skill.values_low else ""
    steps = f"skill {skill.name}: {skill.steps} steps, {skill.result}{source}{value}{low}"
    return f"{steps}, stretch {skill.stretch}"


def _title(result: Result) -> str:
    names = [str(result[key]) for key in ("task", "mode", "distribution") if result.get(key)]
    episodes = result.get("episodes")
    count = f", {episodes} episode{'s' * (episodes != 1)}" if episodes is not None else ""
    return " · ".join(names) + count


def _fact_table(result: Result) -> Table:
    table = Table(title=Text(_title(result)), title_justify="left", show_header=False)
    table.add_column(style="bold")
    table.add_column(justify="right")
    for fact in facts(result):
        style = {True: "green", False: "red", None: ""}[fact.good]
        table.add_row(fact.name, Text(fact.text), style=style)
    return table


def _skill_table(result: Result) -> Table:
    table = Table(title="Skills", title_justify="left")
    table.add_column("skill", style="bold")
    for name in ("steps", "result", "subgoal", "value", "stretch"):
        table.add_column(name, justify="right")
    for row in skill_rows(result):
        style = "" if row.good else "red"
        value = Text(row.value, style="yellow" if row.values_low else "")
        source = row.source or "–"
        table.add_row(
            Text(row.name), row.steps, row.result, source, value, row.stretch, style=style
        )
    return table


def _tight(result: Result) -> tuple[list[MarginRow], str]:
    """The margins to show, and words for all others with the smallest of them."""
    rows = margin_rows(result)
    tight = [row for row in rows if row.margin < TIGHT]
    others = rows[len(tight) :]
    return tight, f"all other rules: {others[0].text} or more" if others else ""


def _margin_table(result: Result) -> Table:
    tight, others = _tight(result)
    table = Table(title="Smallest margins", title_justify="left", caption=others)
    table.add_column("limit", style="bold")
    table.add_column("left", justify="right")
    placed = any(row.where for row in tight)
    if placed:
        table.add_column("where")
    for row in tight:
        cells = (row.label, row.text, row.where) if placed else (row.label, row.text)
        table.add_row(*cells, style="red" if row.margin < 0 else "")
    return table


def _fault_table(result: Result) -> Table:
    table = Table(title="Faults", title_justify="left")
    table.add_column("fault", style="bold")
    for name in ("what happened", "declared", "seen"):
        table.add_column(name)
    for row in struck_rows(result):
        table.add_row(*map(Text, row))
    return table


@contextmanager
def progress(episodes: int, console: Console) -> Iterator[Advance]:
    """A bar over the episodes of a run; a line an episode's tenth where there is no terminal."""
    if console.is_terminal:
        with _bar(console) as bar:
            task = bar.add_task("episodes", total=episodes, note="")
            yield lambda successes: bar.update(task, advance=1, note=f"{successes} succeeded")
        return
    done = 0
    every = max(1, episodes // 10)

    def advance(successes: int) -> None:
        nonlocal done
        done += 1
        if done % every == 0 or done == episodes:
            console.print(f"episode {done} of {episodes}, {successes} succeeded", highlight=False)

    yield advance


def _bar(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[note]}"),
        TimeRemainingColumn(),
        console=console,
    )
