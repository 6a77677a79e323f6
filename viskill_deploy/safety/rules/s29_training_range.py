"""S29: the policy is asked about nothing far from what it has seen in training."""

from __future__ import annotations

from collections.abc import Iterator
from math import inf
from typing import ClassVar

from viskill_deploy.core.types import Action, ObservationRange, Verdict
from viskill_deploy.safety.cycle import Cycle
from viskill_deploy.safety.envelope import ROUNDING, CellEnvelope
from viskill_deploy.safety.ranges import Ranges
from viskill_deploy.safety.rule_base import Needs
from viskill_deploy.safety.soundness import are_sound

HOLD_AFTER_S = 1.0
"""Five policy steps: a tracker's slip is over by then, a scene that is another one is not."""

BEYOND, NOISE = 0.05, 0.002
"""Smallest and largest value of some ten thousand states are not quite the borders: a twentieth of
the width on each side, and 2 mm or 2 mrad where training never moved a number and sensors do."""


def widened(training: ObservationRange) -> Ranges:
    """What the rule allows, from the smallest and largest values of training."""
    lower, upper = [], []
    for low, high in zip(training.lower, training.upper, strict=True):
        room = BEYOND * (high - low) + NOISE
        lower.append(low - room)
        upper.append(high + room)
    return Ranges(lower, upper)


class Rule:
    """WARN while an observation is outside; HOLD when it stays so, or is none at all."""

    id: ClassVar[str] = "S29"
    needs: ClassVar[Needs] = Needs.REQUEST

    def __init__(self, cell: CellEnvelope) -> None:
        training = cell.training or ObservationRange((), ())
        self._ranges, self._size = widened(training), len(training.lower)
        self._seen: tuple[float, ...] = ()
        self._part, self._since = 0.0, inf

    def margin(self, cycle: Cycle) -> float:
        """One minus the farthest number as a part of half its range; 1.0 without an observation."""
        observation = cycle.request.observation
        if observation is not self._seen:  # a new one comes once in a policy step
            self._seen, self._part = observation, self._farthest(observation)
        if self._part <= 1.0:
            self._since = inf
        else:
            self._since = min(self._since, cycle.now)
        return 1.0 - self._part

    def judge(self, cycle: Cycle) -> Iterator[Verdict]:
        """How far outside, as a part of half the range; infinite when nobody can tell."""
        is_long = cycle.now - self._since + ROUNDING >= HOLD_AFTER_S
        action = Action.HOLD if is_long or self._part == inf else Action.WARN
        yield Verdict(self.id, action, value=self._part, limit=1.0)

    def _farthest(self, observation: tuple[float, ...]) -> float:
        if not observation:
            return 0.0
        is_vector = observation.__class__ is tuple and len(observation) == self._size
        if not (is_vector and are_sound(observation)):
            return inf
        return self._ranges.farthest(observation)
