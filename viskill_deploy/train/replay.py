"""Episodes of one skill in memory, and batches of them with goals in hindsight.

Sampling follows hindsight experience replay (M. Andrychowicz et al., NIPS 2017), strategy `future`:
a sample's goal is replaced by what was achieved later in its episode.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Float32Array = npt.NDArray[np.float32]
Success = Callable[[Float32Array, Float32Array], npt.NDArray[np.bool_]]
"""(achieved (B, m), goal (B, m)) → reached (B,)."""


@dataclass(frozen=True, slots=True)
class Episodes:
    """Whole runs of one skill.

    Attributes:
        obs: what was seen, (E, T + 1, n).
        achieved: what stood where the goal would stand, (E, T + 1, m).
        goal: what was to be reached, (E, m).
        action: what was done, (E, T, k).
    """

    obs: Float32Array
    achieved: Float32Array
    goal: Float32Array
    action: Float32Array

    def __len__(self) -> int:
        return len(self.goal)

    def tree(self) -> dict[str, Float32Array]:
        """The arrays by name."""
        return dict(zip(("obs", "achieved", "goal", "action"), _columns(self), strict=True))

    def only(self, rows: npt.NDArray[Any]) -> Episodes:
        """The episodes that `rows` picks."""
        return Episodes(self.obs[rows], self.achieved[rows], self.goal[rows], self.action[rows])


@dataclass(frozen=True, slots=True)
class Batch:
    """Transitions: goal is the same before and after; reward 0 where reached, else -1.

    `last` marks those at the end of their episode.
    """

    obs: Float32Array
    goal: Float32Array
    action: Float32Array
    reward: Float32Array
    next_obs: Float32Array
    next_action: Float32Array
    last: npt.NDArray[np.bool_]


class Replay:
    """The newest episodes of one skill, and some before them.

    Args:
        capacity: episodes kept; a full memory overwrites at random.
        success: the skill's test.
    """

    def __init__(self, capacity: int, success: Success) -> None:
        self._capacity, self._success = capacity, success
        self._held: Episodes | None = None

    def __len__(self) -> int:
        return 0 if self._held is None else len(self._held)

    def add(self, episodes: Episodes, rng: np.random.Generator) -> None:
        """Takes up episodes of the same length as those before."""
        if self._held is None:
            self._held = episodes.only(np.arange(min(len(episodes), self._capacity)))
            return
        room = self._capacity - len(self)
        held = _joined(self._held, episodes.only(np.arange(min(room, len(episodes)))))
        rest = episodes.only(np.arange(room, len(episodes))) if room < len(episodes) else None
        if rest is not None:
            rows = rng.choice(self._capacity, size=len(rest), replace=len(rest) > self._capacity)
            held = Episodes(*(a.copy() for a in _columns(held)))
            for old, new in zip(_columns(held), _columns(rest), strict=True):
                old[rows] = new
        self._held = held

    def sample(self, count: int, hindsight: float, rng: np.random.Generator) -> Batch:
        """`count` transitions; the part `hindsight` of them with goals achieved later."""
        held = self._held
        if held is None:
            raise ValueError("nothing to sample from")
        steps = held.action.shape[1]
        episode = rng.integers(len(held), size=count)
        t = rng.integers(steps - 1, size=count)  # the last step has no next action
        later = t + 1 + (rng.random(count) * (steps - t)).astype(int)
        goal = held.goal[episode].copy()
        relabelled = rng.random(count) < hindsight
        goal[relabelled] = held.achieved[episode, later][relabelled]
        reached = self._success(held.achieved[episode, t + 1], goal)
        return Batch(
            obs=held.obs[episode, t],
            goal=goal,
            action=held.action[episode, t],
            reward=np.where(reached, 0.0, -1.0).astype(np.float32),
            next_obs=held.obs[episode, t + 1],
            next_action=held.action[episode, t + 1],
            last=t == steps - 2,
        )

    def state(self) -> dict[str, Any]:
        """What is held, as a tree of arrays."""
        return {} if self._held is None else self._held.tree()

    def restore(self, tree: dict[str, Any]) -> None:
        """Takes over what `state` gave."""
        self._held = Episodes(**tree) if tree else None


def _columns(episodes: Episodes) -> tuple[Float32Array, ...]:
    return episodes.obs, episodes.achieved, episodes.goal, episodes.action


def _joined(a: Episodes, b: Episodes) -> Episodes:
    return Episodes(*(np.concatenate(pair) for pair in zip(_columns(a), _columns(b), strict=True)))
