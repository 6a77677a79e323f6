"""Trained networks as ONNX graphs, float32, batch first, scaling inside."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper

from viskill_deploy.core.types import FloatArray
from viskill_deploy.train.network import COARSE_M, FINE_M, TURN_GAIN, Scaling
from viskill_deploy.train.subgoal_space import POSITIONS, SubgoalSpace

OPSET = 17
IR_VERSION = 8

Weights = dict[str, FloatArray]
"""Numbers of a `Network` by name."""


class _Graph:
    """Nodes and constants in the making."""

    def __init__(self, **inputs: int) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self._inputs = inputs

    def node(self, kind: str, *inputs: str, **attributes: int) -> str:
        """Adds a node and returns the name of its output."""
        name = f"{kind.lower()}{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [name], name, **attributes))
        return name

    def constant(self, values: npt.ArrayLike, dtype: npt.DTypeLike = np.float32) -> str:
        """Adds a constant and returns its name."""
        name = f"constant{len(self.constants)}"
        array = np.ascontiguousarray(values, dtype=dtype)
        self.constants.append(numpy_helper.from_array(array, name))
        return name

    def columns(self, value: str, start: int, stop: int) -> str:
        """Columns of a matrix."""
        bounds = [self.constant([n], np.int64) for n in (start, stop, 1)]
        return self.node("Slice", value, *bounds)

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
        count = len(weights) // 2
        for layer in range(count):
            matrix = self.constant(weights[f"layers.{layer}.weight"])
            bias = self.constant(weights[f"layers.{layer}.bias"])
            value = self.node("Gemm", value, matrix, bias, transB=1)
            if layer < count - 1:
                value = self.node("Relu", value)
        return value

    def finished(self, value: str, output: str, size: int) -> bytes:
        """The serialised graph with one output."""
        self.nodes.append(helper.make_node("Identity", [value], [output], output))
        graph = helper.make_graph(
            self.nodes,
            output,
            [_tensor(name, length) for name, length in self._inputs.items()],
            [_tensor(output, size)],
            self.constants,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)])
        model.ir_version = IR_VERSION
        onnx.checker.check_model(model)
        serialised: bytes = model.SerializeToString()
        return serialised


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
    return g.finished(action, "action", len(weights["layers.3.bias"]))


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
    return g.finished(g.node("Add", metres, g.constant(space.centre)), "subgoal", POSITIONS)


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
    return g.finished(g.node("Sigmoid", g.head(features, weights)), "value", 1)


def _tensor(name: str, size: int) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", size])
