"""Whether a chaining policy's value is the probability that it claims to be.

Episodes of policies that are worse than the trained one, each in another degree, give the value
something to tell apart. For each skill, the subgoals before it and its own are moved at random by
up to 0, 5, 10, 20 or 40 mm on each axis; later subgoals are the policy's own, because the value at
the skill's start speaks of the policy from there on. Neither training, nor selection, nor
evaluation has seen these layouts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.vector_loop import VectorLoop
from viskill_deploy.train.chain_learning import Chained
from viskill_deploy.train.reliability import Reliability, reliability
from viskill_deploy.train.rollout import fresh, run_task
from viskill_deploy.train.subgoal_space import POSITIONS

CALIBRATION = 2**31 + 2**30
"""Added to the seeds of these episodes: nothing else uses them."""

SPREADS_M = (0.0, 0.005, 0.010, 0.020, 0.040)

PATIENCE = 4
"""Times the wanted episodes that are run at most: bad skills may hardly ever come to a border."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """Values against outcomes.

    Attributes:
        all: of all skills together.
        skills: of the value at each skill's start.
    """

    all: Reliability
    skills: dict[str, Reliability]


def calibrate(loop: VectorLoop, policy: Chained, episodes: int, seed: int) -> Calibration:
    """Compares the values of a chaining policy with what happened.

    Args:
        loop: environments.
        policy: skills, chaining policies and their values.
        episodes: of each skill, at least one, from the task's distributions in turn.
        seed: of layouts and spreads.
    """
    rng = np.random.default_rng((CALIBRATION, seed))
    names = [skill.name for skill in loop.task.skills]
    pairs = [judged(loop, policy, index, episodes, rng) for index in range(len(names))]
    together = reliability(*(np.concatenate(part) for part in zip(*pairs, strict=True)))
    parts = [reliability(*pair) for pair in pairs]
    return Calibration(together, dict(zip(names, parts, strict=True)))


def judged(
    loop: VectorLoop, policy: Chained, index: int, episodes: int, rng: np.random.Generator
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Values at the start of a skill and outcomes of its episodes, (episodes,) each."""
    values: list[FloatArray] = []
    outcomes: list[npt.NDArray[np.bool_]] = []
    run = 0
    while sum(map(len, values)) < episodes and run < PATIENCE * episodes:
        fresh(loop, rng, loop.task.distributions)
        spread = spread_until(loop, index, run, rng)
        done = run_task(loop, policy.moved(spread))
        begun = done.begun[:, index]  # an arm that could not follow leaves nothing to judge
        seen = (done.obs[:, index], done.task_goal, done.subgoal[:, index])
        value = policy.chaining.probability(index, *(part.astype(np.float64) for part in seen))
        values.append(value[begun])
        outcomes.append(done.success[begun])
        run += loop.count
    return np.concatenate(values)[:episodes], np.concatenate(outcomes)[:episodes]


def spread_until(loop: VectorLoop, index: int, run: int, rng: np.random.Generator) -> FloatArray:
    """Moves of the subgoals of all skills up to `index`, (count, skills, 6) m.

    Args:
        loop: says how many.
        index: of the last skill whose subgoal is moved.
        run: episodes before these; the amounts take turns.
        rng: draws the moves.
    """
    turn = (run + np.arange(loop.count)) % len(SPREADS_M)
    amount = np.array(SPREADS_M)[turn, None, None]
    spread: FloatArray = (
        rng.uniform(-1.0, 1.0, (loop.count, len(loop.task.skills), POSITIONS)) * amount
    )
    spread[:, index + 1 :] = 0.0
    return spread
