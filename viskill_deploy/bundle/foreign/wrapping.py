"""An ONNX policy between two pieces of graph: one that makes its observation, one that reads it.

What comes out is a skill graph like any other: `obs`, `goal` → `action`, metres, task frame.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import onnx
from google.protobuf.message import DecodeError
from onnx import compose, inliner

from viskill_deploy.bundle.foreign.description import SUBGOAL, Description
from viskill_deploy.bundle.format import MAX_FILE_BYTES
from viskill_deploy.bundle.graph_writer import GraphWriter
from viskill_deploy.core.errors import BundleError
from viskill_deploy.sim.tasks.base import Layout, Task

PREFIX = "policy/"
MIN_OPSET = 13


class _Wrapper(GraphWriter):
    """Builds the pieces around a policy.

    Args:
        description: what its numbers mean.
        task: whose vectors it gets.
    """

    def __init__(self, description: Description, task: Task) -> None:
        self._sizes = [
            sum(n for _, n in part) for part in (task.observation_layout, task.goal_layout)
        ]
        super().__init__(obs=self._sizes[0], goal=self._sizes[1])
        self._file, self._task = description.file, task
        self._scale, self._origin = description.world(task)
        self._places = _places(task.observation_layout) | {
            SUBGOAL + name: place for name, place in _places(task.goal_layout).items()
        }
        self._fingers = [arm.arm.jaw.finger_length_m for arm in task.cell.arms]

    def stretch(self, name: str) -> str:
        """A stretch of the task's vectors as it is."""
        start, size = self._places[name]
        return self.columns("goal" if name.startswith(SUBGOAL) else "obs", start, start + size)

    def seen(self) -> str:
        """The policy's observation."""
        return self.node("Concat", *map(self._seen, self._file.observation.layout), axis=1)

    def _seen(self, name: str) -> str:
        value, arm = self.stretch(name), self._arm_of(name)
        if self._file.control_point == "jaw-end" and arm is not None:
            if name.endswith("_position"):
                value = self.node("Add", value, self._jaw(arm))
            elif "_from_" in name:
                value = self.node("Sub", value, self._jaw(arm))
        if name.endswith("_position"):
            value = self.node("Add", value, self.constant(self._origin))
        if name.endswith("_position") or "_from_" in name:
            value = self.node("Mul", value, self.constant([self._scale]))
        return value

    def _arm_of(self, name: str) -> int | None:
        """The arm whose point a stretch is about, None where it is about none."""
        for index, arm in enumerate(self._task.cell.arms):
            label = arm.name.lower()
            if name.startswith(f"{label}_") or name.endswith(f"_from_{label}"):
                return index
        return None

    def _jaw(self, arm: int) -> str:
        """From jaw pivot to jaw end, task frame, m: along the EEF's y axis."""
        angles = self.stretch(f"{self._task.cell.arms[arm].name.lower()}_euler")
        parts = [self.columns(angles, k, k + 1) for k in range(3)]
        sr, sp, sy = (self.node("Sin", a) for a in parts)
        cr, cp, cy = (self.node("Cos", a) for a in parts)
        tilt = self.node("Mul", sp, sr)
        x = self.node("Sub", self.node("Mul", cy, tilt), self.node("Mul", sy, cr))
        y = self.node("Add", self.node("Mul", sy, tilt), self.node("Mul", cy, cr))
        z = self.node("Mul", cp, sr)
        axis = self.node("Concat", x, y, z, axis=1)
        return self.node("Mul", axis, self.constant([self._fingers[arm]]))

    def acted(self, answer: str, per_arm: int) -> str:
        """Five numbers an arm from the policy's answer."""
        parts = []
        for index in range(len(self._task.cell.arms)):
            mine = self.columns(answer, per_arm * index, per_arm * (index + 1))
            parts += [
                self._moved(mine, index),
                self._turned(mine, index),
                self._opened(mine, per_arm),
            ]
        return self.node("Concat", *parts, axis=1)

    def _moved(self, mine: str, arm: int) -> str:
        value = self.columns(mine, 0, 3)
        if self._file.action.reference != "absolute":
            return value
        place = self.node("Div", value, self.constant([self._scale]))
        place = self.node("Sub", place, self.constant(self._origin))
        if self._file.control_point == "jaw-end":
            place = self.node("Sub", place, self._jaw(arm))
        tip = self.stretch(f"{self._task.cell.arms[arm].name.lower()}_position")
        unit = self.constant([self._file.action.displacement_m])
        way = self.node("Div", self.node("Sub", place, tip), unit)
        # shortened as a whole, so that a far target is headed for in a straight line
        far = self.node("Abs", way)
        x, y, z = (self.columns(far, k, k + 1) for k in range(3))
        longest = self.node("Max", x, y, z, self.constant([1.0]))
        return self.node("Div", way, longest)

    def _turned(self, mine: str, arm: int) -> str:
        action = self._file.action
        if action.rotation == "none":
            return self.node("Mul", self.columns(mine, 0, 1), self.constant([0.0]))
        value = self.columns(mine, 3, 4)
        if action.rotation == "increment":
            return value
        mode = self._task.action.mode(arm)
        angles = self.stretch(f"{self._task.cell.arms[arm].name.lower()}_euler")
        now = self.columns(angles, *((2, 3) if mode == "yaw" else (1, 2)))
        turn = self.node("Sub", value, now)
        turns = self.node("Div", turn, self.constant([2.0 * math.pi]))
        whole = self.node("Round", turns)
        turn = self.node("Sub", turn, self.node("Mul", whole, self.constant([2.0 * math.pi])))
        return self.node("Div", turn, self.constant([action.rotation_rad]))

    def _opened(self, mine: str, per_arm: int) -> str:
        value = self.columns(mine, per_arm - 1, per_arm)
        if self._file.action.jaw == "binary":
            return value
        return self.node("Sub", value, self.constant([self._file.action.jaw_open_rad / 2.0]))


def wrapped(path: Path, description: Description, task: Task) -> bytes:
    """The skill graph around a policy.

    Args:
        path: of the policy's ONNX file; it has to hold its own weights.
        description: what its numbers mean, checked against the task.
        task: that it is for.

    Raises:
        BundleError: no usable ONNX file.
        DataFileError: the file's input or output is not as described; names the line.
    """
    model = _read(path)
    file, graph = description.file, model.graph
    constants = {entry.name for entry in graph.initializer}
    inputs = {node.name: node for node in graph.input if node.name not in constants}
    outputs = {node.name: node for node in graph.output}
    for word, found, width in (
        (file.observation.input, inputs, description.width(task)),
        (file.action.output, outputs, description.per_arm * len(task.cell.arms)),
    ):
        if word not in found:
            raise description.fault(word, f"{path.name} has {', '.join(found)}")
        shape = found[word].type.tensor_type
        sizes = [d.dim_value for d in shape.shape.dim]
        if shape.elem_type != onnx.TensorProto.FLOAT or len(sizes) != 2 or sizes[1] != width:
            raise description.fault(
                word,
                f"{path.name} has {sizes} there, this file makes float32 [N, {width}] of it; "
                "correct the layout, or export the policy with float32 and a batch axis",
            )
    if len(inputs) != 1:
        raise description.fault(
            file.observation.input, f"{path.name} also needs {', '.join(inputs)}; export it anew"
        )
    wrapper = _Wrapper(description, task)
    seen = wrapper.seen()
    inner = compose.add_prefix(model, PREFIX).graph  # names out of the way of the wrapper's
    wrapper.append(inner, {PREFIX + file.observation.input: seen})
    action = wrapper.acted(PREFIX + file.action.output, description.per_arm)
    answer = {"action": (action, 5 * len(task.cell.arms))}
    try:
        return wrapper.finished(answer, list(model.opset_import), model.ir_version)
    except onnx.checker.ValidationError as error:
        raise BundleError(
            path, f"cannot be wrapped ({error}); export it with another opset"
        ) from error


def _read(path: Path) -> onnx.ModelProto:
    """The model, checked, without functions of its own."""
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise BundleError(path, "is larger than a bundle's file may be; export it smaller")
        model = onnx.load_model(path, format="protobuf", load_external_data=False)
        onnx.checker.check_model(model)
    except (OSError, DecodeError, onnx.checker.ValidationError, ValueError) as error:
        if isinstance(error, BundleError):
            raise
        raise BundleError(path, f"is no usable ONNX file ({error}); export it again") from error
    if any(entry.data_location == onnx.TensorProto.EXTERNAL for entry in model.graph.initializer):
        raise BundleError(path, "keeps its weights in another file; export it with them inside")
    opsets = {entry.domain: entry.version for entry in model.opset_import}
    if opsets.get("", 0) < MIN_OPSET:
        raise BundleError(
            path, f"has opset {opsets.get('', 0)}; export it with {MIN_OPSET} or newer"
        )
    return inliner.inline_local_functions(model)


def _places(layout: Layout) -> dict[str, tuple[int, int]]:
    """Start and size of every stretch."""
    starts = np.cumsum([0, *(size for _, size in layout)]).tolist()
    return {name: (start, size) for (name, size), start in zip(layout, starts, strict=False)}
