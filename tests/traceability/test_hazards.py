"""Every hazard has its invariant, every invariant its code and its tests, every link is real."""

import re

import pytest
import traceability
from traceability import DOCUMENT, IDS, ROOT

HAZARDS, FILES, TESTS = (
    traceability.hazards(),
    traceability.files_by_invariant(),
    traceability.tests_by_invariant(),
)


@pytest.mark.parametrize("invariant", IDS)
def test_every_invariant_stands_against_a_hazard_and_has_words(invariant):
    assert any(invariant in hazard.invariants for hazard in HAZARDS)
    assert traceability.WORDS[invariant]


@pytest.mark.parametrize("invariant", sorted(IDS))
def test_every_invariant_is_kept_by_code_and_checked_by_tests(invariant):
    assert FILES[invariant], f"no file keeps {invariant}; name it in tests/traceability"
    for file in FILES[invariant]:
        assert (ROOT / file).is_file(), f"{invariant} names {file}, which is not there"
    assert TESTS[invariant], (
        f'no test counts for {invariant}; mark one with @pytest.mark.invariant("{invariant}")'
    )


def test_no_marker_or_hazard_names_an_invariant_that_there_is_not():
    assert set(TESTS) == set(IDS)
    assert {id_ for hazard in HAZARDS for id_ in hazard.invariants} <= set(IDS)
    assert len({hazard.id for hazard in HAZARDS}) == len(HAZARDS)


def test_docs_safety_says_what_every_invariant_is():
    text = (DOCUMENT.parent / "safety.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (S\d\d) \|", text, re.MULTILINE)
    assert rows == sorted(IDS)


def test_the_page_names_every_hazard_and_no_file_that_there_is_not():
    text = DOCUMENT.read_text(encoding="utf-8")
    assert text == traceability.page(), "run `make hazards`"
    for hazard in HAZARDS:
        assert f"| {hazard.id} | {hazard.text} |" in text, "run `make hazards`"
    for file in re.findall(r"`((?:unit|property|faults|integration|traceability)/[^`]+)`", text):
        assert (ROOT / "tests" / file).is_file(), f"{file} is gone; run `make hazards`"


def test_pytest_sees_the_same_links(request):
    """The reading of the files agrees with what pytest itself has collected here."""
    for item in request.session.items:
        id_ = item.nodeid.split("[")[0]
        marked = {id_ for mark in item.iter_markers("invariant") for id_ in mark.args}
        skipped = item.get_closest_marker("skip") or item.get_closest_marker("xfail")
        if not skipped:
            assert marked == {name for name in TESTS if id_ in TESTS[name]}
