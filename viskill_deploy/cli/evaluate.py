"""`viskill evaluate`: how often a trained method does its task in the learning world."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from viskill_deploy.core.errors import MissingExtraError

if TYPE_CHECKING:
    from viskill_deploy.train.results import Figures

EXAMPLE = "Example: viskill evaluate runs/viskill --distribution wide --episodes 200"


def command(
    run: Annotated[Path, typer.Argument(help="Folder that `viskill train` wrote.")],
    method: Annotated[
        str | None, typer.Option(help="Which of the methods that are learned there.")
    ] = None,
    distribution: Annotated[
        str | None, typer.Option(help="Layouts: reference or wide; both by default.")
    ] = None,
    episodes: Annotated[int, typer.Option(min=1, help="How many in each distribution.")] = 100,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of the layouts; that of the run by default.")
    ] = None,
    threads: Annotated[int, typer.Option(min=1, help="Threads of physics.")] = 1,
    json_: Annotated[
        bool, typer.Option("--json", help="Print the figures as one JSON object, nothing else.")
    ] = False,
) -> None:
    """Evaluate a trained method in deterministic episodes that training has never seen."""
    try:
        from viskill_deploy.cli.learning_display import StageBars  # noqa: PLC0415 - torch
        from viskill_deploy.train import unit  # noqa: PLC0415 - is an extra
        from viskill_deploy.train.evaluate import evaluate  # noqa: PLC0415
        from viskill_deploy.train.results import figures_of  # noqa: PLC0415
        from viskill_deploy.train.run import Run  # noqa: PLC0415
    except ModuleNotFoundError as error:
        raise MissingExtraError("train", "viskill evaluate") from error
    console = Console(stderr=json_)
    opened = Run.open(run, lambda line: console.print(line, markup=False), threads)
    name = _method(run, method, unit.learned(run))
    known = opened.task.distributions
    if distribution is not None and distribution not in known:
        raise typer.BadParameter(f"{opened.task_name} has the distributions {', '.join(known)}")
    policy, _ = unit.learn(name, opened)
    layouts = opened.seed if seed is None else seed
    scores = {}
    for where in (distribution,) if distribution else known:
        with StageBars(console) as bars:
            opened.watch, count = bars.watch, opened.counting(where)
            figures = figures_of(evaluate(opened.trial, policy, where, episodes, layouts, count))
        scores[where] = dataclasses.asdict(figures)
        console.print(_line(where, figures), markup=False, highlight=False, soft_wrap=True)
    if json_:
        facts = {"task": opened.task_name, "method": name, "seed": opened.seed}
        print(json.dumps({**facts, "layout_seed": layouts, "scores": scores}))


def _method(run: Path, asked: str | None, learned: list[str]) -> str:
    there = f"learned in {run}: {', '.join(learned) or 'nothing yet'}"
    if asked is None and len(learned) == 1:
        return learned[0]
    if asked not in learned:
        raise typer.BadParameter(f"name a method with --method; {there}")
    return asked


def _line(distribution: str, figures: Figures) -> str:
    skills = ", ".join(f"{name} {rate:.2f}" for name, rate in figures.skills.items())
    steps = f"{figures.rollout_length:.1f}" if figures.rollout_length is not None else "-"
    return (
        f"{distribution}: success {figures.success_rate:.3f} of {figures.episodes} episodes, "
        f"{figures.subtasks:.2f} subtasks ({skills}), rollout length {steps}"
    )
