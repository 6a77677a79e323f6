"""What terminals show is shown as it is: names of files and people's texts are no markup."""

import io

from rich.console import Console

from viskill_deploy.observe.preflight_table import print_preflight
from viskill_deploy.observe.tables import print_tables
from viskill_deploy.runtime.checklist import Line


def terminal() -> tuple[Console, io.StringIO]:
    page = io.StringIO()
    return Console(file=page, width=100, force_terminal=True, color_system=None), page


def test_a_runs_tables_show_brackets() -> None:
    console, page = terminal()
    print_tables({"task": "lab", "distribution": "scene [/v2].toml", "episodes": 1}, console)
    assert "scene [/v2].toml" in page.getvalue()


def test_a_preflights_table_shows_brackets() -> None:
    console, page = terminal()
    look = Line("robot", "", "pass", None, "lab [/v2].toml stands in front")
    print_preflight("mine [/v3]", [look], [], console)
    assert "mine [/v3]" in page.getvalue()
    assert "lab [/v2].toml stands in front" in page.getvalue()
