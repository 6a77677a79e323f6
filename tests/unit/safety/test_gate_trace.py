"""The gate says what it said: every number of every rule, on random walks and in its own stops."""

import gate_trace
import pytest

GOLDEN = gate_trace.golden()
OURS: dict[str, list[str]] = {}


def held(title: str, lines: list[str]) -> None:
    for number, (ours, agreed) in enumerate(zip(lines, GOLDEN[title], strict=False)):
        assert gate_trace.same(ours, agreed), f"{title}, line {number}: {gate_trace.__doc__}"
    assert len(lines) == len(GOLDEN[title])


@pytest.mark.parametrize("title", [t for t in GOLDEN if t.startswith("walk")])
def test_the_gate_says_on_a_walk_what_was_agreed_on(title):
    held(title, gate_trace.walk(int(title.split()[1])))


@pytest.mark.parametrize("cell", gate_trace.CELLS)
def test_stops_reaches_and_points_of_an_arm_are_what_was_agreed_on(cell):
    held(f"arms of {cell}", gate_trace.arms(cell))


def test_stops_of_a_joint_are_what_was_agreed_on():
    held("stops of a joint", gate_trace.joint_stops())


def test_common_stops_are_what_was_agreed_on():
    held("common stops", gate_trace.common_stops())
