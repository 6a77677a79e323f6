"""Runs `viskill` with the arguments given; at SIGUSR1 it tells its stray sockets (`crtk_peer`).

The first argument is the file that is told.
"""

import json
import signal
import sys
from pathlib import Path
from typing import Any

from crtk_peer import strays

from viskill_deploy.cli.main import main


def tell(*_: Any) -> None:
    """Writes the file whole or not at all."""
    part = TOLD.with_suffix(".part")
    part.write_text(json.dumps(strays()))
    part.replace(TOLD)


if __name__ == "__main__":
    TOLD = Path(sys.argv.pop(1))
    signal.signal(signal.SIGUSR1, tell)
    main()
