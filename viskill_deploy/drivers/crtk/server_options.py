"""How the simulated dVRK behaves, as far as one may choose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.crtk.topics import Version
from viskill_deploy.sim.tracker import TrackerOptions

Homing = Literal["dvrk", "stay"]


@dataclass(frozen=True, slots=True)
class ServerOptions:
    """Options of a simulated dVRK.

    Attributes:
        version: whose names, tolerances and marks of invalid data it has.
        homing: where an arm goes when it is homed for the first time: "dvrk" goes where dVRK's
            kinematic simulation goes, 12 cm into the cannula; "stay" stays where it is, as an arm
            does whose instrument is in the cannula already.
        rate_hz: how often periodic topics are published; at most the cell's own rate counts.
        scene_hz: how often the poses of things, and of tips, are published.
        arms: those on the wire; () for all of the cell.
        tracker: what is wrong with a tracker that sees the tips; None for no tracker.
        seed: of its noise.
    """

    version: Version = "2.4"
    homing: Homing = "dvrk"
    rate_hz: float = 100.0
    scene_hz: float = 50.0
    arms: tuple[str, ...] = ()
    tracker: TrackerOptions | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        for value, known in ((self.version, get_args(Version)), (self.homing, get_args(Homing))):
            if value not in known:
                raise DriverError(f"{value!r} is none of {', '.join(known)}; choose one of them")
        if not (0.0 < self.rate_hz <= 1000.0 and 0.0 < self.scene_hz <= 1000.0):
            raise DriverError("rates are in (0, 1000] Hz; 100 is dVRK's own")
