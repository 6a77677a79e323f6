"""Every threshold is what was agreed on, and a change of any number in a file is found.

Each number of a file that the gate goes by is changed in eight ways, in a copy of the file: it has
to be refused, or to show in the thresholds that the gate then has. The second is found by the
golden file.
"""

import re
from collections.abc import Iterator

import gate_numbers
import pytest

from viskill_deploy.core.data import packaged_roots
from viskill_deploy.core.errors import DataFileError

ROBOTS = next(root / "robots" for root in packaged_roots() if (root / "robots").exists())
FILES = {
    "psm_classic.toml": "bipegtransfer",
    "tools/large_needle_driver_400006.toml": "bipegtransfer",
    "cells/bipegtransfer.toml": "bipegtransfer",
    "cells/bipegboard.toml": "bipegboard",
    "cells/matchboardpanel.toml": "matchboardpanel",
    "iiwa14_straight.toml": "bodytrainer",
    "cells/bodytrainer.toml": "bodytrainer",
}
"""File: a cell that uses it."""
NOT_OF_THE_GATE = re.compile(
    r"^schema|actuator_to_joint|dynamics|effort_nm|grip_angle|step_s"
    r"|^camera|start_|^(ring|block|letter|surrol)\b|^board\.size"
    r"|^panel\.(door_(mass|friction|damping)|handle_(radius|from_door))"
)
"""Numbers for the simulator, the pictures, the plan and other people's policies."""
WITHOUT_EFFECT = {
    "iiwa14_straight.toml": re.compile(
        r"shaft_length|jaw_radius|^gate\.(position_margin|first_command|tracking)_m$"
    )
}
"""A picture's; of a jaw that may touch all there is; of joints that slide, where none does."""
NUMBER = re.compile(r"(?<![\w.\"])-?\d+(?:\.\d*)?(?:e-?\d+)?(?![\w.\"])")
GOLDEN = gate_numbers.golden()


def numbers_of(text: str) -> Iterator[tuple[str, int, int]]:
    """(name, start, end) of every number in a file that the gate goes by."""
    table = key = ""
    place = 0
    for line in text.splitlines(keepends=True):
        code = line.split("#")[0]
        header = re.match(r"\[+([\w.]+)\]+", code)
        assigned = re.match(r"\s*(\w+)\s*=", code)
        if header:
            table = header[1]
        elif assigned:
            key = assigned[1]
        if not header and not NOT_OF_THE_GATE.search(f"{table}.{key}".lstrip(".")):
            for found in NUMBER.finditer(code, assigned.end() if assigned else 0):
                yield f"{table}.{key}", place + found.start(), place + found.end()
        place += len(line)


def changes(old: float) -> dict[str, float]:
    """Ways to get a number wrong."""
    if old == 0.0:
        return {"+1 mm": 0.001, "-1 mm": -0.001, "1": 1.0, "NaN": float("nan")}
    others = {"x0.95": 0.95 * old, "x1.05": 1.05 * old, "x-1": -old, "0": 0.0}
    return others | {"NaN": float("nan"), "m to mm": 1000.0 * old, "mm to m": 0.001 * old}


def outcome(relative: str, text: str, root, monkeypatch) -> str:
    """`refused`, `seen` (the thresholds differ from the golden ones) or `missed`."""
    path = root / "robots" / relative
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    monkeypatch.setenv("VISKILL_DATA", str(root))
    try:
        thresholds = gate_numbers.thresholds(FILES[relative])
    except DataFileError as error:
        assert error.path
        return "refused"
    return "missed" if thresholds == GOLDEN["cells"][FILES[relative]] else "seen"


@pytest.mark.no_cover
@pytest.mark.invariant("S31")
@pytest.mark.parametrize("relative", FILES)
def test_any_wrong_number_in_a_file_is_refused_or_seen(relative, tmp_path, monkeypatch):
    text = (ROBOTS / relative).read_text(encoding="utf-8")
    idle = WITHOUT_EFFECT.get(relative)
    places = [found for found in numbers_of(text) if not (idle and idle.search(found[0]))]
    assert len(places) >= 8
    missed, refused = [], 0
    for name, start, end in places:
        for how, new in changes(float(text[start:end])).items():
            changed = f"{text[:start]}{new!r}{text[end:]}"
            found = outcome(relative, changed, tmp_path, monkeypatch)
            refused += found == "refused"
            if found == "missed":
                missed.append(f"{name} {text[start:end]} {how}")
    assert not missed
    assert refused >= len(places)  # NaN, if nothing else


@pytest.mark.invariant("S31")
@pytest.mark.parametrize("relative", FILES)
def test_lower_and_upper_bounds_that_were_swapped_are_refused_or_seen(
    relative, tmp_path, monkeypatch
):
    text = (ROBOTS / relative).read_text(encoding="utf-8")
    pairs = re.findall(r"^(\w*lower\w*)( = .*)\n(\w*upper\w*)( = .*)$", text, re.MULTILINE)
    for low, low_value, high, high_value in pairs:
        old = f"{low}{low_value}\n{high}{high_value}"
        changed = text.replace(old, f"{low}{high_value}\n{high}{low_value}")
        assert changed != text
        assert outcome(relative, changed, tmp_path, monkeypatch) == "refused"
    assert pairs


@pytest.mark.parametrize("cell", sorted(GOLDEN["checks"]))
@pytest.mark.invariant("S31")
def test_every_value_of_a_file_is_held_against_the_bounds_that_were_agreed_on(cell):
    assert gate_numbers.checks(cell) == GOLDEN["checks"][cell], gate_numbers.__doc__


def test_the_files_as_they_are_give_the_golden_thresholds():
    assert gate_numbers.collect()["cells"] == GOLDEN["cells"], gate_numbers.__doc__


@pytest.mark.parametrize("name", sorted(GOLDEN["constants"]))
def test_a_number_in_the_code_is_what_was_agreed_on(name):
    assert gate_numbers.constants()[name] == GOLDEN["constants"][name], gate_numbers.__doc__
