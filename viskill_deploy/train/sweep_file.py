"""The file of a sweep: which units, with which settings, measured how."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field

from viskill_deploy.core.errors import DataFileError
from viskill_deploy.sim.tasks.base import load_task, task_names
from viskill_deploy.train.methods import method_names, needs_skills
from viskill_deploy.train.results import Measuring, Unit
from viskill_deploy.train.settings import RunSettings, checked, content_of

AtLeastOne = Annotated[int, Field(ge=1)]
Seed = Annotated[int, Field(ge=0)]


@dataclass(frozen=True, slots=True)
class Block:
    """Every one of these methods on every one of these tasks with every one of these seeds."""

    tasks: Annotated[tuple[str, ...], Field(min_length=1)]
    methods: Annotated[tuple[str, ...], Field(min_length=1)]
    seeds: Annotated[tuple[Seed, ...], Field(min_length=1)]


@dataclass(frozen=True, slots=True)
class SweepFile:
    """What the TOML file may say. Folders count from where the command is run.

    Attributes:
        units: what to do; units that are named twice are done once.
        output: folder of the runs.
        results: folder that result files are copied to as they arrive, none without it.
        processes: units at the same time.
        measuring: how every unit is measured.
        settings: of every run.
        task_settings: what a task's runs have otherwise, by task.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    units: Annotated[tuple[Block, ...], Field(min_length=1)]
    output: Path = Path("runs/sweep")
    results: Path | None = None
    processes: AtLeastOne = 2
    measuring: Measuring = field(default_factory=Measuring)
    settings: dict[str, Any] = field(default_factory=dict)
    task_settings: dict[str, dict[str, Any]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Sweep:
    """A sweep, ready to run.

    Attributes:
        units: in the order in which they are begun: first one of every task and seed that learns
            the shared skills, then the others as the file names them.
        settings: of the runs, by task.
        measuring: how every unit is measured.
        output, results, processes: as in the file.
    """

    units: tuple[Unit, ...]
    settings: dict[str, RunSettings]
    measuring: Measuring
    output: Path
    results: Path | None
    processes: int


def read_sweep(path: Path) -> Sweep:
    """The sweep of a TOML file.

    Raises:
        DataFileError: names file, key and reason.
    """
    file = checked(path, SweepFile, content_of(path))
    _check_names(path, file)
    used = dict.fromkeys(task for block in file.units for task in block.tasks)
    settings = {task: _settings_of(path, file, task) for task in {*used, *file.task_settings}}
    units = ordered(file.units)
    return Sweep(units, settings, file.measuring, file.output, file.results, file.processes)


def _settings_of(path: Path, file: SweepFile, task: str) -> RunSettings:
    """The settings of a task's runs; a wrong one is named as the file has it."""
    special = file.task_settings.get(task, {})
    try:
        settings = checked(path, RunSettings, merged(file.settings, special))
        _check(path, "distributions", settings.distributions, load_task(task).distributions)
    except DataFileError as error:
        entry: Any = special
        for part in error.key.split("."):
            entry = entry.get(part) if isinstance(entry, Mapping) else None
        table = "settings" if entry is None else f"task_settings.{task}"
        if not error.key:  # the reason names it, and it may come of both
            raise DataFileError(path, f"settings of {task}", error.reason) from error
        raise DataFileError(path, f"{table}.{error.key}", error.reason) from error
    return settings


def ordered(blocks: tuple[Block, ...]) -> tuple[Unit, ...]:
    """Every unit once; those that learn the skills which others of their run wait for first."""
    units = dict.fromkeys(
        Unit(task, method, seed)
        for block in blocks
        for seed in block.seeds
        for task in block.tasks
        for method in block.methods
    )
    first: dict[tuple[str, int], Unit] = {}
    for unit in units:
        if needs_skills(unit.method):
            first.setdefault((unit.task, unit.seed), unit)
    return tuple(dict.fromkeys([*first.values(), *units]))


def merged(common: Mapping[str, Any], special: Mapping[str, Any]) -> dict[str, Any]:
    """`common` with the entries of `special`, table by table."""
    both = {**common, **special}
    for key, value in special.items():
        old = common.get(key)
        if isinstance(value, Mapping) and isinstance(old, Mapping):
            both[key] = merged(old, value)
    return both


def _check_names(path: Path, file: SweepFile) -> None:
    for kind, known in (("tasks", task_names()), ("methods", method_names())):
        for index, block in enumerate(file.units):
            _check(path, f"units.{index}.{kind}", getattr(block, kind), known)
    _check(path, "task_settings", file.task_settings, task_names())


def _check(
    path: Path, key: str, names: Mapping[str, Any] | tuple[str, ...], known: Sequence[str]
) -> None:
    for name in names:
        if name not in known:
            raise DataFileError(path, key, f"{name!r} is unknown; choose of {', '.join(known)}")
