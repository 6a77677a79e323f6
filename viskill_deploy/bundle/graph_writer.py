"""ONNX graphs in the making: float32, batch first. Needs the `onnx` package, no torch."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import numpy.typing as npt
import onnx
from onnx import TensorProto, helper, numpy_helper

OPSET = 17
IR_VERSION = 8


class GraphWriter:
    """Nodes and constants in the making.

    Args:
        inputs: width of every input [N, width], by name.
    """

    def __init__(self, **inputs: int) -> None:
        self._nodes: list[onnx.NodeProto] = []
        self._constants: list[onnx.TensorProto] = []
        self._inputs = inputs

    def node(self, kind: str, *inputs: str, **attributes: int) -> str:
        """Adds a node and returns the name of its output."""
        name = f"{kind.lower()}{len(self._nodes)}"
        self._nodes.append(helper.make_node(kind, list(inputs), [name], name, **attributes))
        return name

    def constant(self, values: npt.ArrayLike, dtype: npt.DTypeLike = np.float32) -> str:
        """Adds a constant and returns its name."""
        name = f"constant{len(self._constants)}"
        array = np.ascontiguousarray(values, dtype=dtype)
        self._constants.append(numpy_helper.from_array(array, name))
        return name

    def columns(self, value: str, start: int, stop: int) -> str:
        """Columns of a matrix."""
        bounds = [self.constant([n], np.int64) for n in (start, stop, 1)]
        return self.node("Slice", value, *bounds)

    def network(self, value: str, layers: Iterable[tuple[npt.ArrayLike, npt.ArrayLike]]) -> str:
        """Linear layers, weights (out, in) and biases (out,), with ReLU between them."""
        for index, (weight, bias) in enumerate(layers):
            value = self.node("Relu", value) if index else value
            value = self.node("Gemm", value, self.constant(weight), self.constant(bias), transB=1)
        return value

    def append(self, graph: onnx.GraphProto, inputs: Mapping[str, str]) -> None:
        """Takes over the nodes and constants of a graph whose names are its own.

        Args:
            graph: what to append.
            inputs: the value in this graph that stands for each of its inputs.
        """
        for name, value in inputs.items():
            self._nodes.append(helper.make_node("Identity", [value], [name], name))
        self._nodes.extend(graph.node)
        self._constants.extend(graph.initializer)

    def finished(
        self,
        outputs: Mapping[str, tuple[str, int]],
        opsets: Sequence[onnx.OperatorSetIdProto] = (),
        ir_version: int = IR_VERSION,
    ) -> bytes:
        """The serialised graph.

        Args:
            outputs: inner name and width of every output, by its name; the first is the answer.
            opsets: of an appended graph; this module's own by default.
            ir_version: likewise.
        """
        for output, (value, _) in outputs.items():
            self._nodes.append(helper.make_node("Identity", [value], [output], output))
        graph = helper.make_graph(
            self._nodes,
            next(iter(outputs)),
            [_tensor(name, length) for name, length in self._inputs.items()],
            [_tensor(name, length) for name, (_, length) in outputs.items()],
            self._constants,
        )
        sets = list(opsets) or [helper.make_opsetid("", OPSET)]
        model = helper.make_model(graph, opset_imports=sets)
        model.ir_version = ir_version
        onnx.checker.check_model(model)
        serialised: bytes = model.SerializeToString()
        return serialised


def _tensor(name: str, size: int) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", size])
