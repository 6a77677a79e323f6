"""Everything that may be set about a training run, and its TOML file."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ConfigDict, TypeAdapter, ValidationError

from viskill_deploy.core.errors import DataFileError
from viskill_deploy.train.chain_learning import ChainAmounts
from viskill_deploy.train.chaining import ChainSettings
from viskill_deploy.train.demos import DemoSettings
from viskill_deploy.train.dex import DexSettings
from viskill_deploy.train.skill_learning import SkillSettings

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class RunSettings:
    """A training run but for its task, method and seed.

    Attributes:
        distributions: layouts are drawn from these in turn.
        environments: episodes side by side.
        demos, skill, dex, chain, amounts: of the parts.
    """

    __pydantic_config__ = ConfigDict(extra="forbid")

    distributions: tuple[str, ...] = ("reference", "wide")
    environments: int = 64
    demos: DemoSettings = field(default_factory=DemoSettings)
    skill: SkillSettings = field(default_factory=SkillSettings)
    dex: DexSettings = field(default_factory=DexSettings)
    chain: ChainSettings = field(default_factory=ChainSettings)
    amounts: ChainAmounts = field(default_factory=ChainAmounts)


def read_settings(path: Path | None) -> RunSettings:
    """The settings of a TOML file, defaults for what it leaves out; all defaults without one.

    Raises:
        DataFileError: names file, key and reason.
    """
    if path is None:
        return RunSettings()
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise DataFileError(path, "", f"cannot be read as TOML ({error}); correct it") from error
    return checked(path, RunSettings, content)


def checked(path: Path, kind: type[T], content: dict[str, Any]) -> T:
    """`content` as a `kind`; refuses with file, key and reason."""
    try:
        return TypeAdapter(kind).validate_python(content)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise DataFileError(path, key, f"{first['msg']}; correct it") from error
