"""`viskill faults`: what can be made to go wrong in a dry-run, and what the gate does about it."""

from __future__ import annotations

import json
import sys
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from viskill_deploy.observe.faults import fault_rows

EXAMPLE = "Example: viskill dry-run policies/bipegtransfer-viskill --fault drop@2.0:0.3"


def command(
    json_: Annotated[bool, typer.Option("--json", help="Print the list as JSON.")] = False,
) -> None:
    """List the faults that `viskill dry-run --fault` knows, with the declared reaction to each."""
    rows = fault_rows()
    if json_:
        print(json.dumps([row._asdict() for row in rows]))
        return
    if not sys.stdout.isatty():
        for row in rows:
            print(f"{row.name}: {row.what}; {row.reaction}")
        return
    table = Table(title="Write --fault name@start[:duration], in seconds", title_justify="left")
    for name in ("fault", "what happens", "what the gate does"):
        table.add_column(name, style="bold" if name == "fault" else "")
    for row in rows:
        table.add_row(row.name, row.what, row.reaction)
    Console().print(table)
