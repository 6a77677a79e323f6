"""The paper's tables with our numbers, from result files alone."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from viskill_deploy.core.errors import TrainingError
from viskill_deploy.train.order import told_order
from viskill_deploy.train.paper import (
    ABLATIONS,
    BASELINES,
    CORE_HOURS,
    MAIN,
    PUBLISHED,
    TASKS,
    TITLES,
    Published,
)
from viskill_deploy.train.reliability import Bin, pooled
from viskill_deploy.train.results import Figures, Result, read_result
from viskill_deploy.train.settings import RunSettings, settings_facts
from viskill_deploy.train.value_figure import draw_values

NOT_RUN = "not run"
SHARED = ("demos", "skill-")
"""How the stages begin that all methods of a run share."""

INTRODUCTION = """# Reproduction of the paper's tables

T. Huang et al., *Value-Informed Skill Chaining for Policy Learning of Long-Horizon Tasks with
Surgical Robot*, IROS 2023.

**The simulator is ours.** The paper's numbers come from its authors' PyBullet world; ours come from
this project's MuJoCo cell, with other contacts, other limits of motion, layouts and budgets of the
same kind, and our own implementation of every method. The numbers stand side by side to compare
the order of the methods; that a success rate here is above or below the paper's says nothing about
the paper.

Ours: mean ± standard deviation over seeds; each seed is measured in deterministic full-length
episodes in the learning world, on `reference` layouts (and `wide` ones in the last column) that
neither training nor selection has seen. What success, subtasks completed and rollout length mean is
written in [learning.md](learning.md). The paper's: its Tables I and II, five seeds.
"{not_run}" is a cell without a result file.

This page is built by `{command}` from the files in
`{source}`{sweep}. They come from commit {commits}.{unusual}
"""

ORDER = """Two methods count as told apart if zero is outside the 95 % confidence interval of the
difference of their success over the seeds that both have run, two at least
(`viskill_deploy/train/order.py`). Methods that do the task every time cannot be ranked by success.
The paper's layouts are `reference`; `wide` ones are ours.
"""


@dataclass(frozen=True, slots=True)
class Results:
    """Result files of a folder, in the order of tasks, methods and seeds."""

    all: tuple[Result, ...]

    def of(self, task: str, method: str) -> list[Result]:
        """The seeds of a method on a task."""
        return [r for r in self.all if (r.unit.task, r.unit.method) == (task, method)]


def read_results(folder: Path) -> Results:
    """Every result file in a folder.

    Raises:
        TrainingError: there are none, or two of the same unit, or some of a task that were learned
            or measured otherwise than the others.
        DataFileError: one is wrong.
    """
    found: dict[tuple[str, str, int], Result] = {}
    protocols: dict[str, tuple[Path, object]] = {}
    for path in sorted(folder.glob("*.json")):
        result = read_result(path)
        key = (result.unit.task, result.unit.method, result.unit.seed)
        if key in found:
            raise TrainingError(f"{path} is a second result of {result.unit.name}; delete one")
        alike = (result.settings, result.measuring)
        first = protocols.setdefault(result.unit.task, (path, alike))
        if first[1] != alike:
            raise TrainingError(
                f"{path} was learned or measured otherwise than {first[0]}; keep results of other "
                "settings in a folder of their own"
            )
        found[key] = result
    if not found:
        raise TrainingError(f"{folder} holds no result files; run `viskill sweep` first")
    return Results(tuple(found[key] for key in sorted(found)))


def reproduce(folder: Path, output: Path, sweep: Path | None = None) -> list[Path]:
    """Writes the page and its figures.

    Args:
        folder: of the result files.
        output: the page, a Markdown file; figures stand beside it.
        sweep: file of the sweep that wrote the results, to be named on the page if it is known.

    Returns:
        The files written.

    Raises:
        TrainingError, DataFileError: see `read_results`.
        MissingExtraError: matplotlib is not installed.
    """
    results = read_results(folder)
    output.parent.mkdir(parents=True, exist_ok=True)
    figure = output.with_name(f"{output.stem}-value.svg")
    calibrated = {
        title: [r.calibration for r in results.of(task, MAIN) if r.calibration is not None]
        for task, title in TASKS.items()
    }
    draw_values(figure, {title: parts for title, parts in calibrated.items() if parts})
    output.write_text(page(results, folder, output, figure.name, sweep), encoding="utf-8")
    return [output, figure]


def page(results: Results, folder: Path, output: Path, figure: str, sweep: Path | None) -> str:
    """The whole page as Markdown."""
    command = f"viskill reproduce {folder} -o {output}"
    command += f" --sweep {sweep}" if sweep else ""
    parts = [
        INTRODUCTION.format(
            not_run=NOT_RUN,
            command=command,
            source=folder,
            sweep=f", which `viskill sweep {sweep}` writes" if sweep else "",
            commits=", ".join(_commits(results)),
            unusual=_unusual(results),
        ),
        "## Table I: methods\n",
        *(_task_table(results, task, BASELINES) for task in TASKS),
        "## Table II: ablations\n",
        *(_task_table(results, task, ABLATIONS) for task in ablated(results)),
        "## Does the paper's order hold?\n",
        ORDER,
        *(f"- {line}" for line in order(results)),
        "\n## Value against success\n",
        _values(results, figure),
        "## Time\n",
        _times(results),
    ]
    return "\n".join(parts)


def _unusual(results: Results) -> str:
    """The settings that are not the defaults, by task."""
    usual = settings_facts(RunSettings())
    told = {r.unit.task: ", ".join(differing(r.settings, usual)) for r in results.all}
    lines = [f"\n- {TASKS[task]}: {changed}" for task, changed in told.items() if changed]
    return "\n\nSettings that differ from the defaults:\n" + "".join(lines) if lines else ""


def differing(settings: Mapping[str, Any], usual: Mapping[str, Any], inside: str = "") -> list[str]:
    """`key = value` of every setting that differs from `usual`."""
    found = []
    for key, value in settings.items():
        other = usual.get(key)
        if isinstance(value, Mapping) and isinstance(other, Mapping):
            found += differing(value, other, f"{inside}{key}.")
        elif value != other:
            found.append(f"`{inside}{key} = {value}`")
    return found


def _commits(results: Results) -> list[str]:
    """Short names of the commits that results come from; `+` stands for further changes."""
    known = {commit for r in results.all for commit in (r.training.commit, *_stages(r))}
    return sorted(
        "unknown" if commit is None else commit[:9] + "+" * commit.endswith("+") for commit in known
    )


def _stages(result: Result) -> list[str | None]:
    return list(result.training.stages.values())


def ablated(results: Results) -> list[str]:
    """Tasks on which the paper or we ran ablations."""
    ran = {r.unit.task for r in results.all if r.unit.method in ABLATIONS and r.unit.method != MAIN}
    return [task for task in TASKS if task in ran or "viskill_sr" in PUBLISHED[task]]


def _task_table(results: Results, task: str, methods: Sequence[str]) -> str:
    head = ["method", "seeds", "success % (paper)", "success %", "subtasks (paper)", "subtasks"]
    head += ["rollout length (paper)", "rollout length", "success %, wide layouts"]
    if not any(results.of(task, method) for method in methods):
        return f"### {TASKS[task]}\n\n{NOT_RUN}\n"
    rows = [_row(results.of(task, m), m, PUBLISHED[task].get(m)) for m in methods]
    return f"### {TASKS[task]}\n\n{_table(head, rows)}"


def _row(runs: Sequence[Result], method: str, paper: Published | None) -> list[str]:
    def ours(read: Callable[[Figures], float | None], distribution: str = "reference") -> str:
        known = [read(r.scores[distribution]) for r in runs if distribution in r.scores]
        return spread(known) if known else NOT_RUN

    def percent(figures: Figures) -> float:
        return 100.0 * figures.success_rate

    episodes = sorted({f.episodes for r in runs for f in r.scores.values()})
    seeds = f"{len(runs)} x {'/'.join(map(str, episodes))} episodes" if runs else "0"
    length = paper and paper.length
    return [
        TITLES[method],
        seeds,
        _published(paper.success) if paper else "-",
        ours(percent),
        f"{paper.subtasks:.2f}" if paper and paper.subtasks is not None else "-",
        ours(lambda f: f.subtasks),
        _published(length) if length else "-",
        ours(lambda f: f.rollout_length),
        ours(percent, "wide"),
    ]


def spread(values: Iterable[float | None], digits: int = 2) -> str:
    """Mean ± sample standard deviation of the numbers that are there."""
    known = [value for value in values if value is not None]
    if not known:
        return "-"
    mean = statistics.fmean(known)
    deviation = f" ± {statistics.stdev(known):.{digits}f}" if len(known) > 1 else ""
    return f"{mean:.{digits}f}{deviation}"


def _published(pair: tuple[float, float | None]) -> str:
    mean, deviation = pair
    return f"{mean:.2f}" + ("" if deviation is None else f" ± {deviation:.2f}")


def order(results: Results) -> list[str]:
    """For each task, then again on wide layouts, how methods stand that the paper has ranked."""
    return [
        f"**{TASKS[task]}**{note}: "
        + told_order(task, {m: results.of(task, m) for m in published}, distribution)
        for distribution, note in (("reference", ""), ("wide", ", wide layouts"))
        for task, published in PUBLISHED.items()
    ]


def _values(results: Results, figure: str) -> str:
    """Calibration of ViSkill's value, a row a task, and the figure."""
    rows = []
    for task, title in TASKS.items():
        known = [r.calibration.all for r in results.of(task, MAIN) if r.calibration is not None]
        if not known:
            rows.append([title, *[NOT_RUN] * 5])
            continue
        groups = pooled(known).groups
        errors = spread((part.error for part in known), 3)
        rows.append([title, str(sum(part.episodes for part in known)), errors])
        rows[-1] += [_group(groups[name]) for name in ("low", "middle", "high")]
    head = ["task", "episodes", "expected calibration error", "success, low value"]
    head += ["middle value", "high value"]
    return (
        "How often the whole task succeeds, by what ViSkill's value said at the start of a skill "
        "(low: below 1/3, high: from 2/3). Episodes are of policies whose subgoals were moved by "
        "up to 0, 5, 10, 20 or 40 mm; the error is the mean over seeds, of ten bins of equal "
        f"width.\n\n{_table(head, rows)}\n![State value against success]({figure})\n"
    )


def _group(group: Bin) -> str:
    return "-" if group.success is None else f"{group.success:.2f} of {group.count}"


def _times(results: Results) -> str:
    """Seconds of every method on every task, and the comparison with the official code."""
    head = ["method", *(f"{title}, s" for title in TASKS.values())]
    rows = []
    for method, title in TITLES.items():
        runs = [results.of(task, method) for task in TASKS]
        rows.append([title, *(_seconds(part) for part in runs)])
    compared = _table(
        ("one seed of ViSkill", "official code, core-hours", "ours, core-hours", "times less"),
        (_compared(results, task, hours) for task, hours in CORE_HOURS.items()),
    )
    return (
        "Wall time of one seed, mean over seeds: demonstrations and skills, which methods share, "
        "+ what the method adds (+ evaluation and calibration). Other units may have run beside "
        f"it on the same machine.\n\n{_table(head, rows)}\n"
        "The official code's hours are those of one core, extrapolated from measured rates of its "
        "simulator and of its updates (by hand; no command of this project measures it).\n\n"
        f"{compared}"
    )


def _seconds(runs: Sequence[Result]) -> str:
    if not runs:
        return NOT_RUN
    shared = statistics.fmean(_shared(r) for r in runs)
    own = statistics.fmean(sum(r.training.seconds.values()) - _shared(r) for r in runs)
    measuring = statistics.fmean(sum(r.measuring_seconds.values()) for r in runs)
    return f"{shared:.0f} + {own:.0f} (+ {measuring:.0f})"


def _shared(result: Result) -> float:
    return sum(s for stage, s in result.training.seconds.items() if stage.startswith(SHARED))


def _compared(results: Results, task: str, hours: float) -> list[str]:
    runs = results.of(task, MAIN)
    if not runs:
        return [TASKS[task], f"{hours:.0f}", NOT_RUN, NOT_RUN]
    ours = statistics.fmean(sum(r.training.seconds.values()) * r.training.threads for r in runs)
    return [TASKS[task], f"{hours:.0f}", f"{ours / 3600:.2f}", f"{hours * 3600 / ours:.0f}"]


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
