"""Official networks as ONNX graphs: scaled units, normalizer and clip inside.

The first output is what a bundle needs; the others are what the official code computes besides,
for people and tests. An input that the network does not look at is declared all the same, so that
every bundle's graphs take the same.
"""

from __future__ import annotations

from viskill_deploy.bundle.format import CHOSEN_SIZE, TASK_GOAL_SIZE
from viskill_deploy.bundle.graph_writer import GraphWriter
from viskill_deploy.bundle.official.checkpoint import ChainNetworks, Normalizer, SkillNetworks

SUBGOAL_RANGE = 4.0
"""Scaled units (0.8 m): what 1 of a chaining action means, as a position in the world."""

LOG_STD_LOWER, LOG_STD_UPPER = -5.0, 2.0
"""Range that a raw log-std is squashed into."""


def skill_graph(skill: SkillNetworks) -> bytes:
    """`obs` [N, n], `goal` [N, m] → `action` [N, k], `network_input` [N, n + m], `q` [N, 1].

    `q` is the critic's value of that action.
    """
    g = GraphWriter(obs=len(skill.observation.mean), goal=len(skill.goal.mean))
    seen = g.node(
        "Concat",
        _normalized(g, "obs", skill.observation),
        _normalized(g, "goal", skill.goal),
        axis=1,
    )
    action = g.node("Tanh", g.network(seen, skill.actor))
    value = g.network(g.node("Concat", seen, action, axis=1), skill.critic)
    return g.finished(
        {
            "action": (action, len(skill.actor[-1][1])),
            "network_input": (seen, skill.actor[0][0].shape[1]),
            "q": (value, 1),
        }
    )


def chain_graph(chain: ChainNetworks) -> bytes:
    """`obs` [N, n], `task_goal` [N, 3] → `subgoal` [N, 6], `log_std` [N, 6]."""
    g = GraphWriter(obs=chain.actor[0][0].shape[1], task_goal=TASK_GOAL_SIZE)
    answer = g.network("obs", chain.actor)
    mean = g.node("Tanh", g.columns(answer, 0, CHOSEN_SIZE))
    raw = g.node("Tanh", g.columns(answer, CHOSEN_SIZE, 2 * CHOSEN_SIZE))
    half = (LOG_STD_UPPER - LOG_STD_LOWER) / 2.0
    log_std = g.node(
        "Add",
        g.node("Mul", g.node("Add", raw, g.constant(1.0)), g.constant(half)),
        g.constant(LOG_STD_LOWER),
    )
    subgoal = g.node("Mul", mean, g.constant(SUBGOAL_RANGE))
    return g.finished({"subgoal": (subgoal, CHOSEN_SIZE), "log_std": (log_std, CHOSEN_SIZE)})


def value_graph(chain: ChainNetworks, goal: int) -> bytes:
    """`obs`, `task_goal`, `subgoal` [N, m] → `value` [N, 1], the smaller of `q1` and `q2` [N, 1].

    Only the six positions that lead the subgoal count.

    Args:
        chain: the networks.
        goal: length of a whole subgoal.
    """
    size = chain.actor[0][0].shape[1]
    g = GraphWriter(obs=size, task_goal=TASK_GOAL_SIZE, subgoal=goal)
    positions = g.columns("subgoal", 0, CHOSEN_SIZE)
    choice = g.node("Div", positions, g.constant(SUBGOAL_RANGE))
    seen = g.node("Concat", "obs", choice, axis=1)
    first, second = (g.network(seen, critic) for critic in chain.critics)
    return g.finished(
        {"value": (g.node("Min", first, second), 1), "q1": (first, 1), "q2": (second, 1)}
    )


def _normalized(g: GraphWriter, vector: str, scale: Normalizer) -> str:
    """The vector as the network gets it."""
    centred = g.node("Sub", vector, g.constant(scale.mean))
    scaled = g.node("Div", centred, g.constant(scale.std))
    low, high = (g.constant(limit) for limit in (-scale.clip, scale.clip))
    return g.node("Max", g.node("Min", scaled, high), low)
