"""ViSkill-LDM: as ViSkill-DM, with a measure that is learned against the states that are met.

The paper names this ablation without a definition; this is our reading of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from viskill_deploy.sim.tasks.base import Task
from viskill_deploy.train.chaining import ChainSettings, Transitions
from viskill_deploy.train.initiation import Likeness
from viskill_deploy.train.methods.viskill import learn_chain
from viskill_deploy.train.methods.viskill_dm import MeasuredChaining
from viskill_deploy.train.optimiser import restore, state_of
from viskill_deploy.train.rollout import TaskPolicy
from viskill_deploy.train.run import Run, demos_of


class LearnedMeasures(MeasuredChaining):
    """The same with measures that learn beside the values.

    Args:
        task: the task.
        settings: numbers of the algorithm.
        seed: of the first weights.
        measures: of every skill's starts, in order.
    """

    def __init__(
        self, task: Task, settings: ChainSettings, seed: int, measures: Sequence[Likeness]
    ) -> None:
        super().__init__(task, settings, seed, measures)
        self._learned = tuple(measures)
        self._rng = np.random.default_rng((seed, 4))

    def update(
        self, index: int, online: Transitions, reached: Transitions | None
    ) -> dict[str, float]:
        """One step of the measure, then of values and policy."""
        if index < self.skills - 1:
            self._learned[index + 1].update(online.next_obs, self._rng)
        return super().update(index, online, reached)

    def state(self) -> dict[str, Any]:
        """Everything that learning goes on from."""
        measures = [state_of(m.network, m.optimiser) for m in self._learned]
        return {
            **super().state(),
            "measures": measures,
            "batches": self._rng.bit_generator.state,
        }

    def restore(self, tree: dict[str, Any]) -> None:
        """Takes over what `state` gave."""
        super().restore(tree)
        self._rng.bit_generator.state = tree["batches"]
        for part, measure in zip(tree["measures"], self._learned, strict=True):
            restore(part, measure.network, measure.optimiser)


def learn(run: Run) -> TaskPolicy:
    """Skills, then chaining policies towards what looks like demonstrated starts."""
    measures = [
        Likeness(run.task, demos.clean.obs[:, 0], run.seed + index)
        for index, demos in enumerate(demos_of(run))
    ]
    chaining = LearnedMeasures(run.task, run.settings.chain, run.seed, measures)
    return learn_chain(run, "chain-viskill_ldm", chaining)
