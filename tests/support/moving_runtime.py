"""A runtime to be killed: `python moving_runtime.py FOLDER DRIVER` drives a served cell for ever.

Both arms swing to and fro at up to 45 mm/s through gate, driver and recorder, as in a run. Prints
one JSON object when they have begun to, and a second one when the gate has ended the run, which
also is the only way in which it ends by itself (exit code 5).
"""

from __future__ import annotations

import itertools
import json
import sys
from pathlib import Path

import numpy as np

from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.drivers.crtk.simulated import PrivateCrtk
from viskill_deploy.drivers.loopback_served import ServedLoopback
from viskill_deploy.motion.resolve import waypoint_at
from viskill_deploy.motion.waypoints import ActionSpec, apply_action
from viskill_deploy.observe.recording import Recorder
from viskill_deploy.runtime.episodes import axes_of
from viskill_deploy.runtime.line import Line
from viskill_deploy.runtime.session import Session
from viskill_deploy.sim.tasks.base import load_task

AWAY = np.array([0.7, -0.3, 0.4, 0.0, -1.0, 0.7, 0.3, 0.4, 0.0, -1.0])
BACK = np.array([-0.7, 0.3, -0.4, 0.0, -1.0, -0.7, -0.3, -0.4, 0.0, -1.0])
STEPS = 3
"""Steps in one direction before the arms turn."""


def served(name: str, cell: CellDescription) -> tuple[ServedLoopback | PrivateCrtk, ServedLoopback]:
    """A driver, "loopback" or "crtk", and the process with its arms."""
    if name == "crtk":
        driver = PrivateCrtk(cell)
        return driver, driver.server
    server = ServedLoopback(cell)
    return server, server


def main(folder: Path, name: str) -> int:
    """Runs; returns the exit code."""
    cell = load_cell("bipegtransfer")
    driver, server = served(name, cell)
    driver.connect()
    driver.reset(load_task("bipegtransfer").sample_layout(np.random.default_rng(0), "reference"))
    line = Line(cell, driver.period_s)
    with (
        Recorder(folder, cell, driver.period_s) as recorder,
        Session(cell, driver, line, recorder) as session,
    ):
        waypoint = waypoint_at(cell, axes_of(session.make_ready()))
        session.begin()
        recorder.mark(driver.clock.now(), 0, "swing", 0)
        for step in itertools.count():
            action = AWAY if step // STEPS % 2 == 0 else BACK
            waypoint = apply_action(waypoint, action, waypoint.T_task_tip, cell, ActionSpec())
            session.go_to(waypoint)
            if step == 1:
                tell(
                    socket=str(server.path),
                    server=server.process.pid if server.process else 0,
                    watchdog=driver.watch.process.pid,
                    domain=driver.network.domain if isinstance(driver, PrivateCrtk) else -1,
                    recorder=recorder._process.pid,
                )
            while session.cycle():
                if session.line.arrived:
                    break
            else:
                session.come_to_rest()
                tell(cause=session.cause, mode=session.gate.mode.value)
                return 5
    raise AssertionError("unreachable")


def tell(**what: object) -> None:
    """One line for whoever has started this."""
    print(json.dumps(what), flush=True)


if __name__ == "__main__":
    raise SystemExit(main(Path(sys.argv[1]), sys.argv[2]))
