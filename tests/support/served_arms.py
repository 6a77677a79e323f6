"""Simulated dVRK arms in a process that outlives the drivers of a test: each connects anew."""

import functools
from typing import Any

from crtk_domain import DOMAIN

from viskill_deploy.core.description import load_cell
from viskill_deploy.drivers.base import Driver
from viskill_deploy.drivers.crtk.opening import LOOPBACK, Network
from viskill_deploy.drivers.crtk.simulated import ServedCrtk, served_arms
from viskill_deploy.drivers.loopback_served import ServedLoopback
from viskill_deploy.sim.world import WorldOptions

CELL = load_cell("bipegtransfer")
OPTIONS = WorldOptions(period_s=0.01)
LAST = 7
"""Of the domains of this run: arms that stay are in nobody's way there."""


class Kept:
    """The side of arms that stay when a driver goes."""

    def __init__(self, server: ServedLoopback) -> None:
        self._server = server

    def __getattr__(self, name: str) -> Any:
        return getattr(self._server, name)

    def close(self) -> None:
        """They stay."""


@functools.cache
def arms(transport: str, network: Network) -> ServedLoopback:
    """The process; it ends with this one."""
    server = served_arms(CELL, transport, network, OPTIONS)
    server.connect()
    return server


def connected(transport: str) -> Driver:
    """A driver that has just connected to arms without power, at which nobody stands."""
    network = Network(DOMAIN + LAST, LOOPBACK)
    server = arms(transport, network)
    server.say(consent=False, estop=False)
    driver = ServedCrtk(CELL, transport, network, Kept(server), OPTIONS.period_s)
    driver.connect()
    return driver
