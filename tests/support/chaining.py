"""Chaining bundles made of affine graphs: small, but with every part that a trained one has."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from viskill_deploy.bundle.format import (
    MANIFEST,
    Manifest,
    chain_file,
    value_file,
    write_manifest,
)
from viskill_deploy.sim.tasks.base import load_task

SHIPPED = Path(__file__).resolve().parents[2] / "policies" / "bipegtransfer-viskill"
THRESHOLD = 0.5
VALUES = {"grasp": 0.8, "handover": 0.9, "release": 0.95}

OBS, GOAL = 35, 3
THING, FRAME1, FRAME2, TIP2_Z = 14, 23, 29, 9
"""Where block, grasp frames and PSM2's height stand in an observation of BiPegTransfer."""

TRAVEL_M, STEP_BACK_M, SHARE = 0.043, 0.015, 0.3
"""Heights of the scripted plan, and the part of the way that PSM1 carries the block."""


def affine_graph(
    sizes: Sequence[tuple[str, int]],
    output: str,
    matrix: np.ndarray,
    bias: np.ndarray,
    squash: bool = False,
) -> bytes:
    """A graph that answers `matrix` times its inputs plus `bias`, through a sigmoid if asked."""
    weights = {"w": matrix.astype(np.float32).T, "b": np.asarray(bias, dtype=np.float32)}
    nodes = [
        helper.make_node("Concat", [name for name, _ in sizes], ["x"], axis=1),
        helper.make_node("Gemm", ["x", "w", "b"], ["y"]),
        helper.make_node("Sigmoid" if squash else "Identity", ["y"], [output]),
    ]
    inputs = [helper.make_tensor_value_info(n, TensorProto.FLOAT, ["N", k]) for n, k in sizes]
    outputs = [helper.make_tensor_value_info(output, TensorProto.FLOAT, ["N", len(bias)])]
    initializers = [numpy_helper.from_array(values, name) for name, values in weights.items()]
    graph = helper.make_graph(nodes, output, inputs, outputs, initializers)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    return bytes(model.SerializeToString())


def chain_graph(bias: Sequence[float], observation: int = OBS, goal: int = GOAL) -> bytes:
    """A chaining graph that always chooses the same."""
    sizes = (("obs", observation), ("task_goal", goal))
    return affine_graph(sizes, "subgoal", np.zeros((len(bias), observation + goal)), np.array(bias))


def value_graph(
    value: float, observation: int = OBS, goal: int = GOAL, subgoal: int = 8, size: int = 1
) -> bytes:
    """A value graph that always tells the same."""
    sizes = (("obs", observation), ("task_goal", goal), ("subgoal", subgoal))
    matrix = np.zeros((size, observation + goal + subgoal))
    return affine_graph(sizes, "value", matrix, np.full(size, value))


def scripted_like(skill: str) -> bytes:
    """The scripted plan of BiPegTransfer without its hidden noise, as a chaining graph.

    The plan is affine in what is seen at a skill's start: the block stands on its peg before the
    grasp, and hangs over it, at the height of the meeting, before the handover.
    """
    matrix, bias = np.zeros((6, OBS + GOAL)), np.zeros(6)

    def axis(row: int, index: int, factor: float = 1.0) -> None:
        matrix[row, index] += factor

    for k in range(2):
        axis(k, (FRAME1 if skill == "grasp" else FRAME2) + k)
        axis(3 + k, (FRAME2 if skill == "grasp" else FRAME1) + k)
    if skill == "grasp":  # PSM1 over the meeting place, PSM2 over the peg at its height
        axis(1, THING + 1, -1.0)
        axis(2, FRAME1 + 2)
        axis(5, FRAME2 + 2)
        bias[2] = bias[5] = TRAVEL_M
    else:  # PSM2 back over the meeting place, PSM1 with the block on the way to the goal
        axis(1, THING + 1, -1.0)
        axis(4, THING + 1, -1.0)
        axis(2, TIP2_Z)
        axis(5, TIP2_Z)
        for k in range(2):  # y: the way to the goal begins at the meeting place, not at the peg
            axis(3 + k, OBS + k, SHARE)
            axis(3 + k, THING + k, -SHARE if k == 0 else 0.0)
    bias[2] += STEP_BACK_M
    return affine_graph((("obs", OBS), ("task_goal", GOAL)), "subgoal", matrix, bias)


def make_chaining(folder: Path, value: bool = True) -> Path:
    """Turns a bundle for BiPegTransfer in `folder` into one with a chaining policy, in place."""
    skills = [skill.name for skill in load_task("bipegtransfer").skills]
    for skill in skills[:-1]:
        (folder / chain_file(skill)).write_bytes(scripted_like(skill))
    for skill in skills if value else ():
        (folder / value_file(skill)).write_bytes(value_graph(VALUES[skill]))
    table = {"graphs": {s: value_file(s) for s in skills}, "threshold": THRESHOLD}
    resign(
        folder,
        name="bipegtransfer-chained",
        subgoals="chaining",
        chaining={"graphs": {skill: chain_file(skill) for skill in skills[:-1]}},
        value=table if value else None,
    )
    return folder


def resign(folder: Path, **changes: Any) -> None:
    """Writes the manifest again, changed, with the hashes of the files as they are."""
    content = json.loads((folder / MANIFEST).read_text()) | changes
    write_manifest(folder, Manifest.model_validate(content))


def replace_file(folder: Path, name: str, content: bytes) -> None:
    """Puts other bytes into a file of a bundle, with its hash, as a wrong exporter would."""
    (folder / name).write_bytes(content)
    resign(folder)


def affinely_chained(folder: Path) -> Path:
    """The shipped skills, chained by affine graphs: a bundle that does the task."""
    shutil.copytree(SHIPPED, folder)
    return make_chaining(folder)


def unchained(folder: Path) -> Path:
    """The shipped skills alone; the scripted plan gives their subgoals."""
    shutil.copytree(SHIPPED, folder)
    for pattern in ("chain-*.onnx", "value-*.onnx"):
        for path in folder.glob(pattern):
            path.unlink()
    resign(folder, name="unchained", subgoals="scripted", chaining=None, value=None)
    return folder
