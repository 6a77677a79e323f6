"""Everything that may be set about a training run, and its TOML file."""

from __future__ import annotations

import dataclasses
import json
import math
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ConfigDict, TypeAdapter, ValidationError

from viskill_deploy.core.errors import DataFileError
from viskill_deploy.train.chain_learning import ChainAmounts
from viskill_deploy.train.chaining import ChainSettings
from viskill_deploy.train.demos import DemoSettings
from viskill_deploy.train.dex import DexSettings
from viskill_deploy.train.hidden import HiddenSettings
from viskill_deploy.train.skill_learning import SkillSettings

T = TypeVar("T")

MAY_BE_ZERO = frozenset(
    {
        *(f"skill.{name}" for name in ("imitation_steps", "correction_steps", "polish_steps")),
        *(f"skill.{name}" for name in ("corrections", "rounds", "updates", "ends")),
        *("dex.critic_first", "amounts.updates", "amounts.planned_updates", "hidden.seed"),
    }
)
"""Whole numbers that turn something off; of all others there is at least one."""

PARTS = frozenset(
    {
        *("skill.imitation_hindsight", "skill.enough", "skill.learned_starts"),
        *("dex.discount", "dex.tau", "dex.hindsight", "chain.tau", "amounts.spread_share"),
    }
)
"""Numbers in [0, 1]."""


@dataclass(frozen=True, slots=True)
class RunSettings:
    """A training run but for its task, method and seed.

    Attributes:
        distributions: layouts are drawn from these in turn.
        environments: episodes side by side.
        demos, skill, dex, chain, amounts: of the parts.
        hidden: robots that are not as the cell's files say; none by default.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    distributions: tuple[str, ...] = ("reference", "wide")
    environments: int = 64
    demos: DemoSettings = field(default_factory=DemoSettings)
    skill: SkillSettings = field(default_factory=SkillSettings)
    dex: DexSettings = field(default_factory=DexSettings)
    chain: ChainSettings = field(default_factory=ChainSettings)
    amounts: ChainAmounts = field(default_factory=ChainAmounts)
    hidden: HiddenSettings = field(default_factory=HiddenSettings)

    def __post_init__(self) -> None:
        if not self.distributions:
            raise ValueError("distributions: name at least one")
        for name, value in _numbers(dataclasses.asdict(self)):
            least = 0 if isinstance(value, float) or name in MAY_BE_ZERO else 1
            if not (math.isfinite(value) and value >= least):
                raise ValueError(f"{name} has to be at least {least}, not {value}")
            if name in PARTS and value > 1:
                raise ValueError(f"{name} has to be at most 1, not {value}")
        if self.amounts.rounds <= self.amounts.planned_rounds:
            raise ValueError("amounts.rounds has to be more than amounts.planned_rounds")


def _numbers(table: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, int | float]]:
    """Every number in nested tables, by its dotted key."""
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _numbers(value, f"{before}{key}.")
        elif not isinstance(value, bool | Sequence):
            yield f"{before}{key}", value


def settings_facts(settings: RunSettings) -> dict[str, Any]:
    """The settings as JSON has them; hidden robots are left out where there are none."""
    facts: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(settings)))
    if settings.hidden == HiddenSettings():
        del facts["hidden"]
    return facts


def read_settings(path: Path | None) -> RunSettings:
    """The settings of a TOML or JSON file, defaults for what it leaves out or without a file.

    Raises:
        DataFileError: names file, key and reason.
    """
    return RunSettings() if path is None else checked(path, RunSettings, content_of(path))


def content_of(path: Path) -> dict[str, Any]:
    """What a TOML file says, or a JSON file if it is named `.json`.

    Raises:
        DataFileError: it cannot be read.
    """
    is_json = path.suffix == ".json"
    try:
        text = path.read_text(encoding="utf-8")
        content: dict[str, Any] = json.loads(text) if is_json else tomllib.loads(text)
    except (OSError, ValueError) as error:  # both kinds of syntax error are ValueErrors
        kind = "JSON" if is_json else "TOML"
        raise DataFileError(path, "", f"cannot be read as {kind} ({error}); correct it") from error
    return content


def checked(path: Path, kind: type[T], content: dict[str, Any]) -> T:
    """`content` as a `kind`; refuses with file, key and reason."""
    try:
        return TypeAdapter(kind).validate_python(content)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise DataFileError(path, key, f"{first['msg']}; correct it") from error
