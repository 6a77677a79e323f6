"""Runs a simulated dVRK against the clock, for as long as somebody wants it."""

from __future__ import annotations

import numpy as np

from viskill_deploy.core.clock import Clock
from viskill_deploy.core.description import CellDescription
from viskill_deploy.drivers.crtk.simulated_cell import CrtkCell
from viskill_deploy.sim.tasks.base import load_task, task_names
from viskill_deploy.sim.world import World, WorldOptions


def set_up(cell: CellDescription, seed: int, options: WorldOptions | None = None) -> World:
    """A world with the arms in their start pose and the things where the cell's task puts them.

    Args:
        cell: the cell; one without a task of its name has its things where its scene has them.
        seed: of their places.
        options: period and what is not perfect.
    """
    world = World(cell, options, seed)
    layout = world.scene()
    if cell.name in task_names():
        dice = np.random.default_rng(seed)
        layout = load_task(cell.name, cell).sample_layout(dice, "reference")
    world.reset(layout)
    return world


def run(front: CrtkCell, clock: Clock, until_s: float = np.inf) -> None:
    """Steps the arms until the clock says `until_s`; late once, not for ever."""
    period_s, deadline = front.cell.world.options.period_s, clock.now()
    while deadline < until_s:
        deadline = max(deadline + period_s, clock.now())
        front.advance(clock.sleep_until(deadline))
