"""Skills under the subgoals of the scripted plan: what the others gain from choosing subgoals.

Nothing is learned beyond the skills. The paper has no such row.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.vector_loop import VectorLoop
from viskill_deploy.train.chain_learning import FrozenSkills
from viskill_deploy.train.rollout import Act, TaskPolicy, final_goals, plan_of
from viskill_deploy.train.run import Run, actor, skills_of

CHAINS = False


class Scripted(FrozenSkills):
    """Skills under the subgoals of the scripted plan, as drawn from a seed.

    Args:
        skills: in order.
        seed: of the plan's handover noise.
    """

    def __init__(self, skills: Sequence[Act], seed: int) -> None:
        super().__init__(skills)
        self._seed = seed
        self._plans: FloatArray | None = None

    def subgoals(self, index: int, obs: FloatArray, loop: VectorLoop) -> FloatArray:
        """The plan's subgoals; the last skill's from the task's own goal."""
        if index == 0 or self._plans is None:
            scenes, layouts = loop.scenes(), int(1e6 * np.abs(obs).sum())
            rng = np.random.default_rng((self._seed, 5, layouts))  # the same for the same episodes
            plans = [plan_of(loop.task, obs[i], scenes[i], rng) for i in range(loop.count)]
            self._plans = np.array(plans)
        if index == len(loop.task.skills) - 1:
            return final_goals(loop, obs)
        return self._plans[:, index].copy()


def learn(run: Run) -> TaskPolicy:
    """The skills of the run."""
    return Scripted([actor(run, tree["weights"]) for tree in skills_of(run)], run.seed)
