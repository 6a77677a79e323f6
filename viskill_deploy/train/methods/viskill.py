"""ViSkill: subgoals that make it most likely that the whole task succeeds."""

from __future__ import annotations

from viskill_deploy.train import store
from viskill_deploy.train.chain_learning import Chained, ChainLearner
from viskill_deploy.train.chaining import Chaining
from viskill_deploy.train.rollout import TaskPolicy
from viskill_deploy.train.run import Run, actor, skills_of

STAGE = "chain-viskill"
VALUE_IS_PROBABILITY = True


def learn(run: Run) -> TaskPolicy:
    """Skills, then chaining policies over them."""
    return learn_chain(run, STAGE, Chaining(run.task, run.settings.chain, run.seed))


def learn_chain(run: Run, stage: str, chaining: Chaining) -> TaskPolicy:
    """Lets `chaining` learn over the run's skills; the best policies so far at the end."""
    acts = [actor(run, skill["weights"]) for skill in skills_of(run)]
    if not run.done(stage):
        learner = ChainLearner(
            run.loop, acts, chaining, run.settings.distributions, run.settings.amounts, run.seed
        )
        run.learn(stage, learner)
        run.finish(stage, {**learner.best_weights(), "success": learner.best})
    chaining.load(store.load(run.result(stage)))
    return Chained(acts, chaining)
