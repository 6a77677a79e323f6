"""What a unit of work leaves behind: one JSON file, enough to build every table from."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ConfigDict, TypeAdapter, ValidationError

from viskill_deploy.core.errors import DataFileError
from viskill_deploy.train.calibration import Calibration
from viskill_deploy.train.evaluate import Score

SCHEMA = 1

AGAIN = "delete it and run its unit again, which measures anew what it has learned"


@dataclass(frozen=True, slots=True)
class Unit:
    """One thing to learn: a method on a task from a seed."""

    task: str
    method: str
    seed: int

    @property
    def name(self) -> str:
        """Such as `bipegtransfer-viskill-seed0`."""
        return f"{self.task}-{self.method}-seed{self.seed}"

    def run_folder(self, root: Path) -> Path:
        """Where all methods of this task and seed learn; they share demonstrations and skills."""
        return root / self.task / f"seed{self.seed}"


@dataclass(frozen=True, slots=True)
class Measuring:
    """How a unit is measured.

    Attributes:
        episodes: deterministic ones in each distribution of the task.
        calibration_episodes: of each skill, of ViSkill alone; 0 for none.
    """

    episodes: int = 100
    calibration_episodes: int = 300

    def __post_init__(self) -> None:
        if self.episodes < 1 or self.calibration_episodes < 0:
            raise ValueError("episodes are at least 1, calibration_episodes not negative")


@dataclass(frozen=True, slots=True)
class Training:
    """How a method was learned.

    Attributes:
        seconds: of each stage, shared ones included; what was lost when a run was stopped does not
            count.
        curves: per stage, `round` and the rates `exploring` and `success` as columns.
        threads: of physics.
        peak_memory_mib: of the process that finished the learning.
        versions: of what numbers may depend on.
        commit: of the code that finished the learning, with `+` behind it if it had been changed;
            None outside a checkout.
        stages: the same of the code that finished each stage, as far as it is known.
    """

    seconds: dict[str, float]
    curves: dict[str, dict[str, list[float | None]]]
    threads: int
    peak_memory_mib: float
    versions: dict[str, str]
    commit: str | None
    stages: dict[str, str | None] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Figures:
    """A `Score` in JSON: `rollout_length` is None where no episode succeeded."""

    episodes: int
    success_rate: float
    subtasks: float
    rollout_length: float | None
    skills: dict[str, float]


def figures_of(score: Score) -> Figures:
    """The figures of a score."""
    length = score.rollout_length
    return Figures(
        score.episodes,
        score.success_rate,
        score.subtasks,
        length if math.isfinite(length) else None,
        score.skills,
    )


@dataclass(frozen=True, slots=True)
class Result:
    """A unit that is done.

    Attributes:
        schema: of this file.
        unit: what was learned.
        settings: of the run.
        measuring: how it was measured.
        training: how it was learned.
        scores: by distribution.
        calibration: of ViSkill's value; None for other methods.
        measuring_seconds: of evaluation and calibration.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    schema: int
    unit: Unit
    settings: dict[str, Any]
    measuring: Measuring
    training: Training
    scores: dict[str, Figures]
    calibration: Calibration | None
    measuring_seconds: dict[str, float]


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Writes an object, a line for each of its keys; a crash leaves the old file whole."""
    lines = (f" {json.dumps(k)}: {json.dumps(v, allow_nan=False)}" for k, v in content.items())
    write_whole(path, ("{\n" + ",\n".join(lines) + "\n}\n").encode())


def write_whole(path: Path, content: bytes) -> None:
    """Writes a file, its folder made if missing; whoever reads it finds the old one or the new."""
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(f"{path.name}.{os.getpid()}")
    try:
        new.write_bytes(content)
        new.replace(path)
    finally:
        new.unlink(missing_ok=True)


def write_result(path: Path, result: Result) -> None:
    """Writes a result file."""
    write_json(path, dataclasses.asdict(result))


def read_result(path: Path) -> Result:
    """What `write_result` wrote.

    Raises:
        DataFileError: names file, key and reason.
    """
    try:
        result = TypeAdapter(Result).validate_json(path.read_bytes())
    except OSError as error:
        raise DataFileError(path, "", f"cannot be read ({error})") from error
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise DataFileError(path, key, f"{first['msg']}; {AGAIN}") from error
    if result.schema != SCHEMA:
        raise DataFileError(path, "schema", f"is not {SCHEMA}; {AGAIN}")
    return result
