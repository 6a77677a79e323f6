"""The words for faults: one table, read by the command line, the tests, the report and the docs."""

import math
from pathlib import Path

import pytest

from viskill_deploy.core.types import Action
from viskill_deploy.observe.faults import NOTHING, fault_rows, struck_rows
from viskill_deploy.observe.labels import RULES
from viskill_deploy.runtime.faults import FAULTS, TOLERATED, Injection, parse_fault
from viskill_deploy.runtime.faulty_driver import flipped

DOCS = Path(__file__).parents[3] / "docs" / "safety.md"


def test_there_are_24_faults_and_each_has_a_name_of_its_own() -> None:
    assert len({fault.family or fault.name for fault in FAULTS}) == 24
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_every_reaction_names_a_rule_that_there_is_and_a_time(fault) -> None:
    for reaction in (fault.reaction, fault.at_rest):
        if reaction == TOLERATED:
            continue
        assert reaction.rule in RULES
        assert reaction.action >= Action.HOLD
        assert 0.0 < reaction.within_s <= 2.0
    assert fault.at_rest in (fault.reaction, TOLERATED)


@pytest.mark.parametrize(
    ("text", "start_s", "lasts_s"),
    [
        ("drop@2.0:0.3", 2.0, 0.3),
        ("estop@0", 0.0, math.inf),
        ("clock-1d@1e1:2", 10.0, 2.0),
        ("reconnect@3", 3.0, 0.1),
        ("sigstop@3", 3.0, 1.0),
        ("nan@1:inf", 1.0, math.inf),
    ],
)
def test_a_fault_is_a_name_a_start_and_perhaps_a_duration(text, start_s, lasts_s) -> None:
    injection = parse_fault(text)
    assert injection.fault.name == text.partition("@")[0]
    assert (injection.start_s, injection.lasts_s) == (start_s, lasts_s)
    assert parse_fault(str(injection)) == injection


@pytest.mark.parametrize("text", ["melt@1", "", "@1", "DROP@1", "drop @1"])
def test_a_fault_that_there_is_not_is_refused(text) -> None:
    with pytest.raises(ValueError, match="`viskill faults` lists them"):
        parse_fault(text)


@pytest.mark.parametrize(
    "text",
    [
        "drop",
        "drop@",
        "drop@x",
        "drop@-1",
        "drop@nan",
        "drop@inf",
        "drop@1:",
        "drop@1:0",
        "drop@1:-2",
        "drop@1:nan",
        "drop@1:2:3",
    ],
)
def test_a_time_that_is_none_is_refused_with_the_grammar(text) -> None:
    with pytest.raises(ValueError, match=r"write name@start or name@start:duration"):
        parse_fault(text)


def test_a_fault_acts_from_its_start_to_its_end() -> None:
    injection = parse_fault("drop@2:0.3")
    assert [injection.is_on(t) for t in (1.99, 2.0, 2.299, 2.3, math.nan)] == [
        False,
        True,
        True,
        False,
        False,
    ]
    assert injection.is_on(1.9999999999)
    assert Injection(injection.fault, 2.0, math.inf).is_on(1e6)


def test_the_documents_hold_the_table_of_faults() -> None:
    text = DOCS.read_text(encoding="utf-8")
    for row in fault_rows():
        assert f"| `{row.name}` | {row.what} | {row.reaction} |" in text


def test_what_was_declared_and_seen_is_told_in_words() -> None:
    facts = {
        "fault": "drop@2",
        "what": "no new sample arrives",
        "began": True,
        "declared_rule": "S18",
        "declared_action": "HOLD",
        "declared_within_s": 0.06,
        "seen_rules": ["S18"],
        "seen_action": "HOLD",
        "seen_after_s": 0.052,
    }
    quiet = facts | {"seen_rules": [], "seen_action": "PASS", "seen_after_s": None}
    late = quiet | {"began": False}
    seen, unseen, unborn = struck_rows({"faults": [facts, quiet, late]})
    assert seen.declared == "held within 60 ms: age of the feedback (S18)"
    assert seen.seen == "held after 52 ms: age of the feedback (S18)"
    assert unseen.seen == NOTHING
    assert "had ended" in unborn.seen
    assert struck_rows({}) == []


@pytest.mark.parametrize("value", [0.3, -0.7, 1e-9, -0.99, 0.0])
def test_the_flipped_bit_makes_a_joint_that_no_robot_has(value) -> None:
    assert abs(flipped(value)) >= 2.0
    assert flipped(flipped(value)) == value
