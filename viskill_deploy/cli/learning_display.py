"""What the terminal shows while something learns: a bar for each stage or unit, lines above."""

from __future__ import annotations

from types import TracebackType
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.progress import TaskID as Bar

from viskill_deploy.train.results import Unit
from viskill_deploy.train.sweep import Outcome


class StageBars:
    """A bar for each stage of a run. On something that is not a terminal, lines alone.

    Args:
        console: where to.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._bars: dict[str, Bar] = {}
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.fields[facts]}"),
            TimeElapsedColumn(),
            console=console,
            disable=not console.is_terminal,
        )

    def __enter__(self) -> StageBars:
        self._progress.start()
        return self

    def __exit__(self, *error: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._progress.stop()

    def say(self, line: str) -> None:
        """A line of the run."""
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)

    def watch(self, line: dict[str, Any]) -> None:
        """Moves the stage's bar on."""
        stage = line["stage"]
        if stage not in self._bars:
            self._bars[stage] = self._progress.add_task(stage, total=None, facts="")
        if line.get("done"):
            whole = self._progress.tasks[self._bars[stage]].total or 1
            self._progress.update(self._bars[stage], total=whole, completed=whole)
            return
        rates = [f"{name} {line[name]:.2f}" for name in ("exploring", "success") if name in line]
        self._progress.update(
            self._bars[stage],
            total=line["rounds"],
            completed=line["round"] + 1,
            facts=escape(", ".join(rates)),
        )


class SweepBars:
    """A bar for the sweep and a line for each running unit.

    Args:
        console: where to.
        units: how many there are.
    """

    def __init__(self, console: Console, units: int) -> None:
        self._console = console
        self._lines: dict[Unit, Bar] = {}
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[facts]}"),
            TimeElapsedColumn(),
            console=console,
            disable=not console.is_terminal,
        )
        self._all = self._progress.add_task("units", total=units, facts=f"0/{units}")
        self._units, self._over = units, 0

    def __enter__(self) -> SweepBars:
        self._progress.start()
        return self

    def __exit__(self, *error: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._progress.stop()

    def started(self, unit: Unit, attempt: int) -> None:
        """A process for the unit was started."""
        if unit not in self._lines:
            self._lines[unit] = self._progress.add_task(unit.name, total=None, facts="")
        self._print(f"{unit.name}: " + ("started" if attempt == 1 else "died, started once more"))

    def says(self, unit: Unit, line: str) -> None:
        """The newest line of a running unit."""
        self._progress.update(self._lines[unit], facts=escape(line))

    def over(self, outcome: Outcome) -> None:
        """A unit needs no further process."""
        self._over += 1
        self._progress.update(self._all, completed=self._over, facts=f"{self._over}/{self._units}")
        if outcome.unit in self._lines:
            self._progress.remove_task(self._lines.pop(outcome.unit))
        took = f" after {outcome.seconds:.0f} s" if outcome.attempts else ""
        self._print(f"{outcome.unit.name}: {outcome.status}{took}")

    def _print(self, line: str) -> None:
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)
