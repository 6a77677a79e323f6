"""Faults and the reactions to them, in words: for the terminal, the report and the documents."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from viskill_deploy.core.types import Action
from viskill_deploy.observe.labels import action_label, rule_label
from viskill_deploy.runtime.faults import FAULTS, TOLERATED, Fault, Reaction

NOTHING = "nothing: the run goes on"


class FaultRow(NamedTuple):
    """One fault in words."""

    name: str
    what: str
    reaction: str


class StruckRow(NamedTuple):
    """A fault of a run in words: what had to happen, and what did."""

    fault: str
    what: str
    declared: str
    seen: str


def fault_rows() -> list[FaultRow]:
    """Every fault that can be asked for."""
    return [FaultRow(fault.name, fault.what, _declared(fault)) for fault in FAULTS]


def struck_rows(result: Mapping[str, Any]) -> list[StruckRow]:
    """The faults of a run, from its figures."""
    rows = []
    for facts in result.get("faults") or ():
        declared = _words(
            facts["declared_action"], [facts["declared_rule"]], facts["declared_within_s"], "within"
        )
        seen = _words(facts["seen_action"], facts["seen_rules"], facts["seen_after_s"], "after")
        if not facts["began"]:
            seen = "did not begin: the run had ended before"
        rows.append(StruckRow(facts["fault"], facts["what"], declared, seen))
    return rows


def _declared(fault: Fault) -> str:
    words = _reaction(fault.reaction)
    if fault.at_rest == TOLERATED and fault.reaction != TOLERATED:
        words += "; nothing while the arms are at rest"
    return words


def _reaction(reaction: Reaction) -> str:
    if reaction == TOLERATED:
        return NOTHING
    return _words(reaction.action.name, [reaction.rule], reaction.within_s, "within")


def _words(action: str, rules: list[str], time_s: float | None, when: str) -> str:
    """Action, time and rules, such as "held within 60 ms: age of the feedback (S18)"."""
    if time_s is None:
        return NOTHING
    spoken = ", ".join(rule_label(rule) for rule in rules)
    time = f"{1e3 * time_s:.0f} ms" if time_s < 1.0 else f"{time_s:.1f} s"
    return f"{action_label(Action[action])} {when} {time}: {spoken}"
