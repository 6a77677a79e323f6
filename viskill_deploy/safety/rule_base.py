"""The shape of a rule, and the finder of all rules."""

from __future__ import annotations

import enum
import importlib
import pkgutil
from collections.abc import Iterator
from typing import ClassVar, Final, Protocol

from viskill_deploy.core.errors import SafetyStop
from viskill_deploy.core.types import Action, Verdict
from viskill_deploy.safety import rules
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import CellEnvelope

REQUIRED: Final = frozenset(f"S{number:02d}" for number in (*range(1, 27), 29, 30, 32))
"""A folder from which one of these has gone missing is a broken installation, not a choice."""


class Needs(enum.Enum):
    """What has to be sound before a rule may read it."""

    NOTHING = enum.auto()
    STATE = enum.auto()  # S02 has passed the measurements
    REQUEST = enum.auto()  # S01 and S02 have passed, and the request may go out


class Rule(Protocol):
    """One invariant. Built afresh each time the cell is armed, so memory never outlives a run."""

    id: ClassVar[str]
    needs: ClassVar[Needs]

    def __init__(self, cell: CellEnvelope) -> None: ...

    def margin(self, cycle: Cycle) -> float:
        """Normalised distance to the threshold; the rule is kept if and only if it is >= 0.

        Called in every cycle in which what the rule needs is sound; the place for memory.
        """
        ...

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """What is wrong; called only after a margin that is not >= 0, at least one verdict."""
        ...


def find_rules() -> tuple[type[Rule], ...]:
    """The class of every rule in the folder, ordered by file name.

    Raises:
        SafetyStop: a required rule is not there, or two files claim the same id.
    """
    found: list[type[Rule]] = []
    for module in pkgutil.iter_modules(rules.__path__, rules.__name__ + "."):
        found.append(importlib.import_module(module.name).Rule)
    ids = [rule.id for rule in found]
    missing = sorted(REQUIRED.difference(ids))
    if missing or len(set(ids)) != len(ids):
        raise SafetyStop(
            f"the safety rules are not complete (missing: {missing}, found: {ids}); "
            "install viskill_deploy again"
        )
    return tuple(found)


def verdicts_of(rule: Rule, cycle: Cycle) -> tuple[Verdict, ...]:
    """What a broken rule says; a rule that breaks without a word is a fault."""
    return tuple(rule.judge(cycle)) or (Verdict(rule.id, Action.FAULT),)
