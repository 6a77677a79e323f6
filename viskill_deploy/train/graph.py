"""Trained networks as ONNX graphs, float32, batch first, scaling inside."""

from __future__ import annotations

from viskill_deploy.bundle.graph_writer import GraphWriter
from viskill_deploy.core.types import FloatArray
from viskill_deploy.train.network import COARSE_M, FINE_M, TURN_GAIN, Scaling
from viskill_deploy.train.subgoal_space import POSITIONS, SubgoalSpace

Weights = dict[str, FloatArray]
"""Numbers of a `Network` by name."""


class _Graph(GraphWriter):
    """With what networks of this project compute."""

    def features(self, x: str, scaling: Scaling) -> str:
        """What `Network.features` computes."""
        distances = self.node("MatMul", x, self.constant(scaling.differences.T))
        turns = self.node("MatMul", x, self.constant(2.0 * scaling.turns.T))
        angles = self.node("MatMul", x, self.constant(scaling.angles.T))
        centred = self.node("Sub", x, self.constant(scaling.centre))
        parts = [
            self.node("Div", centred, self.constant(scaling.scale)),
            self.node("Div", distances, self.constant(COARSE_M)),
            self.node("Tanh", self.node("Div", distances, self.constant(FINE_M))),
            self.node("Tanh", self.node("Mul", self.node("Sin", turns), self.constant(TURN_GAIN))),
            self.node("Sin", angles),
            self.node("Cos", angles),
        ]
        return self.node("Concat", *parts, axis=1)

    def head(self, value: str, weights: Weights) -> str:
        """What `Network.head` computes."""
        names = [f"layers.{layer}" for layer in range(len(weights) // 2)]
        pairs = ((weights[f"{name}.weight"], weights[f"{name}.bias"]) for name in names)
        return self.network(value, pairs)


def skill_graph(scaling: Scaling, weights: Weights, observation: int, goal: int) -> bytes:
    """`obs` [N, observation], `goal` [N, goal] → `action` [N, k] in [-1, 1].

    Args:
        scaling: of [obs, goal].
        weights: of the actor.
        observation: length of the observation.
        goal: length of the subgoal.
    """
    g = _Graph(obs=observation, goal=goal)
    features = g.features(g.node("Concat", "obs", "goal", axis=1), scaling)
    action = g.node("Tanh", g.head(features, weights))
    return g.finished({"action": (action, len(weights["layers.3.bias"]))})


def chain_graph(scaling: Scaling, weights: Weights, space: SubgoalSpace, observation: int) -> bytes:
    """`obs` [N, observation], `task_goal` [N, 3] → `subgoal` [N, 6], positions in m.

    Args:
        scaling: of [obs, task_goal].
        weights: of the chaining policy.
        space: that it chooses from.
        observation: length of the observation.
    """
    g = _Graph(obs=observation, task_goal=3)
    features = g.features(g.node("Concat", "obs", "task_goal", axis=1), scaling)
    image = g.node("Tanh", g.columns(g.head(features, weights), 0, POSITIONS))
    metres = g.node("Mul", image, g.constant(space.half))
    subgoal = g.node("Add", metres, g.constant(space.centre))
    return g.finished({"subgoal": (subgoal, POSITIONS)})


def value_graph(scaling: Scaling, weights: Weights, observation: int, goal: int) -> bytes:
    """`obs`, `task_goal` [N, 3], `subgoal` [N, goal] → `value` [N, 1], a probability.

    Args:
        scaling: of [obs, task_goal, positions of the subgoal].
        weights: of the value.
        observation: length of the observation.
        goal: length of the complete subgoal; only its positions count.
    """
    g = _Graph(obs=observation, task_goal=3, subgoal=goal)
    positions = g.columns("subgoal", 0, POSITIONS)
    features = g.features(g.node("Concat", "obs", "task_goal", positions, axis=1), scaling)
    return g.finished({"value": (g.node("Sigmoid", g.head(features, weights)), 1)})
