"""A small bundle whose skills keep still; correct in every other way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from viskill_deploy.bundle.format import Manifest, write_manifest
from viskill_deploy.core.description import load_cell
from viskill_deploy.sim.tasks.base import Task


def linear_graph(
    observation: int = 35, goal: int = 8, action: int = 10, gain: float = 0.0
) -> bytes:
    """A skill that answers `gain` times the mean of what it sees, on every axis."""
    weight = np.full((observation + goal, action), gain / (observation + goal), dtype=np.float32)
    nodes = [
        helper.make_node("Concat", ["obs", "goal"], ["x"], axis=1),
        helper.make_node("MatMul", ["x", "w"], ["y"]),
        helper.make_node("Tanh", ["y"], ["action"]),
    ]
    sizes = (("obs", observation), ("goal", goal))
    inputs = [helper.make_tensor_value_info(n, TensorProto.FLOAT, ["N", k]) for n, k in sizes]
    outputs = [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["N", action])]
    graph = helper.make_graph(
        nodes, "skill", inputs, outputs, [numpy_helper.from_array(weight, "w")]
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    return bytes(model.SerializeToString())


def misshapen_graph(answer: tuple[int, int], low_m: float, high_m: float) -> bytes:
    """A skill of BiPegTransfer that answers in another shape than the [N, 10] that it declares.

    Both arms go down and aside, -0.3 on every axis. While PSM1's tip is between the two heights,
    the answer has the shape `answer`.
    """
    constants = {
        "height": np.array([2]),
        "low": np.float32(low_m),
        "high": np.float32(high_m),
        "right": np.array([1, 10]),
        "change": np.array(answer) - np.array([1, 10]),
    }
    nodes = [
        helper.make_node("Gather", ["obs", "height"], ["column"], axis=1),
        helper.make_node("ReduceSum", ["column"], ["z"], keepdims=0),
        helper.make_node("Greater", ["z", "low"], ["above"]),
        helper.make_node("Less", ["z", "high"], ["below"]),
        helper.make_node("And", ["above", "below"], ["between"]),
        helper.make_node("Cast", ["between"], ["is_wrong"], to=TensorProto.INT64),
        helper.make_node("Mul", ["is_wrong", "change"], ["more"]),
        helper.make_node("Add", ["right", "more"], ["size"]),
        helper.make_node(
            "ConstantOfShape",
            ["size"],
            ["action"],
            value=helper.make_tensor("value", TensorProto.FLOAT, [1], [-0.3]),
        ),
    ]
    inputs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", size])
        for name, size in (("obs", 35), ("goal", 8))
    ]
    outputs = [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["N", 10])]
    tensors = [numpy_helper.from_array(np.asarray(x), name) for name, x in constants.items()]
    graph = helper.make_graph(nodes, "skill", inputs, outputs, tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    return bytes(model.SerializeToString())


def manifest_of(task: Task) -> Manifest:
    """A manifest that fits a task and its cell."""
    cell = load_cell(task.name)
    size = sum(count for _, count in task.observation_layout)
    content = {
        "schema": 1,
        "name": "untrained",
        "task": task.name,
        "cell": cell.name,
        "method": "none",
        "created_by": "tests",
        "arms": [{"name": a.name, "robot": a.entry.robot, "tool": a.entry.tool} for a in cell.arms],
        "frame": "task",
        "control_point": "jaw_pivot",
        "length_unit": "m",
        "step_s": 0.2,
        "action": {
            "reference": "setpoint",
            "displacement_m": task.action.displacement_m,
            "max_displacement_m": task.action.max_displacement_m,
            "rotation": task.action.rotation,
            "rotation_rad": task.action.rotation_rad,
            "pitch_rad": task.action.pitch_rad,
            "jaw": "binary",
            "jaw_open_rad": task.action.jaw_open_rad,
        },
        "observation": [{"name": n, "size": k} for n, k in task.observation_layout],
        "goal": [{"name": n, "size": k} for n, k in task.goal_layout],
        "skills": [
            {
                "name": skill.name,
                "file": f"skill-{skill.name}.onnx",
                "budget": skill.budget,
                "may_open_jaw": list(skill.may_open_jaw),
            }
            for skill in task.skills
        ],
        "subgoals": "scripted",
        "training_range": {"lower": [-7.0] * size, "upper": [7.0] * size},
        "seeds": [0],
        "measured": [],
        "files": {},
    }
    return Manifest.model_validate(content)


def write_untrained(folder: Path, task: Task) -> Path:
    """A bundle for a task whose skills keep still; correct in every other way."""
    folder.mkdir()
    sizes = [sum(n for _, n in layout) for layout in (task.observation_layout, task.goal_layout)]
    for skill in task.skills:
        graph = linear_graph(*sizes, action=5 * len(task.cell.arms))
        (folder / f"skill-{skill.name}.onnx").write_bytes(graph)
    (folder / "MODEL_CARD.md").write_text("# untrained\n", encoding="utf-8")
    write_manifest(folder, manifest_of(task))
    return folder
