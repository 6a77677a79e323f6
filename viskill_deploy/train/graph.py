"""A skill's network as an ONNX graph: inputs `obs` and `goal`, output `action`, float32."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper

from viskill_deploy.core.types import FloatArray
from viskill_deploy.train.network import COARSE_M, FINE_M, TURN_GAIN, Scaling

OPSET = 17
IR_VERSION = 8


class _Graph:
    """Nodes and constants in the making."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def node(self, kind: str, *inputs: str, **attributes: int) -> str:
        """Adds a node and returns the name of its output."""
        name = f"{kind.lower()}{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [name], name, **attributes))
        return name

    def constant(self, values: npt.ArrayLike) -> str:
        """Adds a constant and returns its name."""
        name = f"constant{len(self.constants)}"
        array = np.ascontiguousarray(values, dtype=np.float32)
        self.constants.append(numpy_helper.from_array(array, name))
        return name


def skill_graph(
    scaling: Scaling, weights: dict[str, FloatArray], observation: int, goal: int
) -> bytes:
    """The serialised graph of a `SkillNetwork`.

    Args:
        scaling: of its inputs.
        weights: of its layers, as `SkillNetwork.weights` gives them.
        observation: length of the observation.
        goal: length of the subgoal.
    """
    g = _Graph()
    x = g.node("Concat", "obs", "goal", axis=1)
    distances = g.node("MatMul", x, g.constant(scaling.differences.T))
    turns = g.node("MatMul", x, g.constant(2.0 * scaling.turns.T))
    plain = g.node("Div", g.node("Sub", x, g.constant(scaling.centre)), g.constant(scaling.scale))
    coarse = g.node("Div", distances, g.constant(COARSE_M))
    fine = g.node("Tanh", g.node("Div", distances, g.constant(FINE_M)))
    turned = g.node("Tanh", g.node("Mul", g.node("Sin", turns), g.constant(TURN_GAIN)))
    value = g.node("Concat", plain, coarse, fine, turned, axis=1)
    count = len(weights) // 2
    for layer in range(count):
        matrix = g.constant(weights[f"layers.{layer}.weight"])
        bias = g.constant(weights[f"layers.{layer}.bias"])
        value = g.node("Gemm", value, matrix, bias, transB=1)
        value = g.node("Relu" if layer < count - 1 else "Tanh", value)
    g.nodes.append(helper.make_node("Identity", [value], ["action"], "action"))
    actions = len(weights[f"layers.{count - 1}.bias"])
    graph = helper.make_graph(
        g.nodes,
        "skill",
        [_tensor("obs", observation), _tensor("goal", goal)],
        [_tensor("action", actions)],
        g.constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)])
    model.ir_version = IR_VERSION
    onnx.checker.check_model(model)
    serialised: bytes = model.SerializeToString()
    return serialised


def _tensor(name: str, size: int) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", size])
