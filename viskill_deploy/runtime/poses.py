"""Where the things are when no simulator knows: a scene file, a tracker, and what a jaw holds.

A thing in a jaw is mostly hidden from who looks for it. It is taken to move with the jaw that holds
it, from how it lay there when it was seen last, and that is noted. A thing that nobody has seen for
longer than its limit is nowhere: the run is held (S16), for a person to look.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from typing import Protocol

import numpy as np

from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.scene_files import SeenScene
from viskill_deploy.core.types import FloatArray, ObjectPose, Scene

IN_JAW_M = 0.03
"""A jaw that holds something holds a thing whose centre is within this of its pivot."""

SURE_M = 7.5e-4
"""A sighting that is less certain than this (one sigma) does not tell whether a plan still fits."""


@dataclass(frozen=True, slots=True)
class Sighting:
    """One look at one thing.

    Attributes:
        T_task_object: its pose, (4, 4).
        seen_s: driver's clock when it was seen.
        sigma_m: how well its position is known, standard deviation along the worst axis, m.
    """

    T_task_object: FloatArray
    seen_s: float
    sigma_m: float


class PoseSource(Protocol):
    """Something that sees things: a tracker, or a person who has written down what they saw."""

    def newest(self, name: str) -> Sighting | None:
        """The newest look at a thing; None when it was never seen."""
        ...

    def close(self) -> None:
        """Looks no more; may be called twice."""
        ...


@dataclass(frozen=True, slots=True)
class PoseLimits:
    """What a sighting is good for.

    Attributes:
        age_s: how long a thing that nobody holds is where it was seen.
        held_age_s: how long a thing in a jaw may go unseen.
        sigma_m: a sighting that is less certain is none.
    """

    age_s: float = 0.5
    held_age_s: float = 20.0
    sigma_m: float = 0.003


@dataclass
class _Thing:
    """What is known of one thing."""

    name: str
    T: FloatArray | None = None
    seen_s: float = -inf
    sigma_m: float = inf
    holder: int | None = None
    T_tip_object: FloatArray = field(default_factory=lambda: np.eye(4))
    is_unseen: bool = False


class FiledPoses:
    """The things of a scene file: seen once, and taken to lie there until something moves them.

    Args:
        seen: the scene.
    """

    def __init__(self, seen: SeenScene) -> None:
        self._seen = {
            thing.name: Sighting(thing.T_task_object, 0.0, sigma_of(seen, thing.name))
            for thing in seen.scene.objects
        }

    def newest(self, name: str) -> Sighting | None:
        """As it is in the file."""
        return self._seen.get(name)

    def close(self) -> None:
        """Nothing to end."""


FILED = PoseLimits(age_s=inf, held_age_s=inf)
"""Of a scene file: nobody looks, so nothing gets too old; what moves is reckoned from the jaws."""


class Things:
    """Keeps up with the things of a scene.

    Args:
        scene: which things there are, which to move, where to.
        source: who sees them.
        limits: what a sighting is good for.
        arms: names of the arms, for notes.

    Attributes:
        notes: what people should know afterwards, such as that a thing was not seen in a jaw.
    """

    def __init__(
        self, scene: Scene, source: PoseSource, limits: PoseLimits, arms: Sequence[str]
    ) -> None:
        self._scene, self._source, self._limits = scene, source, limits
        self._arms, self.notes = tuple(arms), list[str]()
        self._things = [_Thing(thing.name) for thing in scene.objects]

    def follow(self, now: float, tips: Sequence[FloatArray], held: Sequence[bool]) -> None:
        """To be called in every control cycle.

        Args:
            now: driver's clock, s.
            tips: measured T_task_tip of every arm.
            held: per arm, whether its jaw holds something.

        Raises:
            DriverError: a thing was not seen for longer than its limit; names it.
        """
        for thing in self._things:
            is_new = self._look(thing)
            self._hold(thing, tips, held)
            if thing.holder is not None and thing.T is not None:
                tip = tips[thing.holder]
                if is_new:
                    thing.T_tip_object = np.linalg.inv(tip) @ thing.T
                else:
                    thing.T = tip @ thing.T_tip_object
                self._note_unseen(thing, now)
            self._insist(thing, now)

    def scene(self, now: float) -> Scene:
        """Where everything is now.

        Raises:
            DriverError: a thing was never seen, or not for longer than its limit.
        """
        poses = []
        for thing in self._things:
            self._look(thing)
            self._insist(thing, now)
            assert thing.T is not None  # it was insisted on
            poses.append(ObjectPose(thing.name, thing.T))
        return Scene(now, tuple(poses), self._scene.active, self._scene.goal)

    def seen(self, now: float) -> Scene:
        """Those things alone that were looked at lately, and well: none of a scene file's.

        Raises:
            DriverError: as `scene`.
        """
        scene, age_s = self.scene(now), -inf if self._limits is FILED else self._limits.age_s
        fresh = {
            thing.name
            for thing in self._things
            if now - thing.seen_s <= age_s and thing.sigma_m <= SURE_M
        }
        return replace(scene, objects=tuple(o for o in scene.objects if o.name in fresh))

    def close(self) -> None:
        """Nobody looks any more."""
        self._source.close()

    def _look(self, thing: _Thing) -> bool:
        """Takes a newer look at a thing, if there is one that is good enough."""
        seen = self._source.newest(thing.name)
        is_good = seen is not None and seen.sigma_m <= self._limits.sigma_m
        if seen is None or not is_good or not seen.seen_s > thing.seen_s:
            return False
        thing.T, thing.seen_s, thing.is_unseen = np.array(seen.T_task_object), seen.seen_s, False
        thing.sigma_m = seen.sigma_m
        return True

    def _hold(self, thing: _Thing, tips: Sequence[FloatArray], held: Sequence[bool]) -> None:
        """Whose jaw a thing is in: the first that closed on it, until it lets go."""
        if thing.T is None or (thing.holder is not None and held[thing.holder]):
            return
        thing.holder = None
        for arm, (tip, has) in enumerate(zip(tips, held, strict=True)):
            if has and np.linalg.norm(tip[:3, 3] - thing.T[:3, 3]) <= IN_JAW_M:
                thing.holder, thing.T_tip_object = arm, np.linalg.inv(tip) @ thing.T
                return

    def _note_unseen(self, thing: _Thing, now: float) -> None:
        # of a scene file nobody looks again: a held thing is unseen from the first moment
        is_late = self._limits is FILED or now - thing.seen_s > self._limits.age_s
        if is_late and not thing.is_unseen and thing.holder is not None:
            thing.is_unseen = True
            self.notes.append(
                f"{thing.name} was not seen in {self._arms[thing.holder]}'s jaw from {now:.1f} s "
                "on: it was taken to move with it"
            )

    def _insist(self, thing: _Thing, now: float) -> None:
        limits = self._limits
        if thing.T is None:
            raise DriverError(
                f"{thing.name} was never seen within {1e3 * limits.sigma_m:g} mm; see that the "
                "tracker runs and publishes it in the task frame"
            )
        limit = limits.age_s if thing.holder is None else limits.held_age_s
        if not now - thing.seen_s <= limit:
            raise DriverError(
                f"{thing.name} was not seen for {now - thing.seen_s:.2f} s (limit {limit:g} s); "
                "look at the tracker and its clock, and whether something hides the thing"
            )


def sigma_of(seen: SeenScene, name: str) -> float:
    """Standard deviation of a thing's position along its worst axis, m."""
    covariance: Mapping[str, FloatArray] = seen.covariance
    return float(np.sqrt(np.linalg.eigvalsh(covariance[name][:3, :3]).max()))
