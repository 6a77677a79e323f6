"""A cell is named by --cell or --robot, whatever the command."""

from collections.abc import Iterator
from typing import Any

import pytest
from typer.main import get_command

from viskill_deploy.cli.main import app

NAMES = {"--cell", "--robot"}
WITH_A_CELL = {
    *("check", "dry-run", "execute", "guard", "convert", "can check", "import trajectory"),
    *("serve crtk", "calibrate collect", "calibrate fit", "calibrate scene", "calibrate truth"),
    *("calibrate port", "calibrate report", "calibrate study"),
}


def cell_options(group: Any, words: tuple[str, ...] = ()) -> Iterator[tuple[str, set[str]]]:
    """Commands that take a cell, and what they call it."""
    for name, command in getattr(group, "commands", {}).items():
        yield from cell_options(command, (*words, name))
    for option in group.params:
        if NAMES & set(option.opts):
            yield " ".join(words), set(option.opts)


FOUND = dict(cell_options(get_command(app)))


def test_these_commands_take_a_cell() -> None:
    assert set(FOUND) >= WITH_A_CELL


@pytest.mark.parametrize("words", sorted(WITH_A_CELL))
def test_a_cell_has_both_names_everywhere(words: str) -> None:
    assert FOUND[words] == NAMES
