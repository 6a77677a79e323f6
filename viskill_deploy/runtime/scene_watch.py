"""Who knows where the things are in a session, and the record of it."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import FloatArray, Scene
from viskill_deploy.drivers.base import Driver
from viskill_deploy.runtime.poses import Things
from viskill_deploy.runtime.record import Recorder

SCENE_PERIOD_S = 0.02
"""The objects are recorded at 50 Hz."""


class SceneWatch:
    """Asks the driver, or whoever else keeps up with the things.

    Args:
        driver: of the cell.
        things: who knows where the things are; None for the driver.
        recorder: where they are recorded.
    """

    def __init__(self, driver: Driver, things: Things | None, recorder: Recorder) -> None:
        self._driver, self._things, self._recorder = driver, things, recorder
        self._due_s = 0.0

    @property
    def has_things(self) -> bool:
        """Whether somebody else than the driver keeps up with things."""
        return self._things is not None

    def scene(self) -> Scene:
        """Where the things are.

        Raises:
            DriverError: nothing tells, or not any more.
        """
        if self._things is not None:
            return self._things.scene(self._driver.clock.now())
        scene = self._driver.scene()
        if scene is None:
            raise DriverError("nothing says where the objects are; give a scene")
        return scene

    def seen(self) -> Scene:
        """The things that somebody sees, without those that are only reckoned with.

        Raises:
            DriverError: nothing tells, or not any more.
        """
        things = self._things
        return self.scene() if things is None else things.seen(self._driver.clock.now())

    def follow(self, now: float, tips: Sequence[FloatArray], held: Sequence[bool]) -> None:
        """Things in a jaw go with it.

        Raises:
            DriverError: a thing was not seen for too long.
        """
        if self._things is not None:
            self._things.follow(now, tips, held)

    def record(self, now: float) -> None:
        """Records the things, when it is due and somebody sees them."""
        is_seen = self._things is not None or self._driver.capabilities.sees_scene
        if is_seen and now >= self._due_s - 1e-9:
            self._due_s = now + SCENE_PERIOD_S
            with contextlib.suppress(DriverError):  # whoever needs to know finds out, too
                self._recorder.scene(now, self.scene())
