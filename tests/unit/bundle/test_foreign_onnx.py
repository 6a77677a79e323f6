"""Any ONNX policy sees what its TOML asks for, and its answer becomes the right waypoint."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from viskill_deploy.bundle.foreign.convert import write_foreign
from viskill_deploy.bundle.foreign.description import Description
from viskill_deploy.bundle.format import Bundle, load_bundle
from viskill_deploy.cli import bring
from viskill_deploy.core.errors import BundleError, DataFileError, ViskillError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.motion.frames import Label, from_task
from viskill_deploy.motion.waypoints import apply_action, start_waypoint, yaw_of
from viskill_deploy.runtime.preflight import prepare
from viskill_deploy.sim.tasks.base import load_task

TASK = load_task("bipegtransfer")
CELL = TASK.cell
GOOD = """schema = 1
task = "bipegtransfer"
rate_hz = 5.0
arms = ["PSM1", "PSM2"]
tools = ["large_needle_driver_400006", "large_needle_driver_400006"]
frame = "surrol"
control_point = "jaw-end"

[observation]
input = "state"
layout = ["psm2_position", "object_from_psm1", "psm1_jaw", "subgoal.second_position"]

[action]
output = "target"
reference = "absolute"
displacement_m = 0.008
max_displacement_m = 0.009
rotation = "absolute"
rotation_rad = 0.4
jaw = "angle"
jaw_open_rad = 0.6
"""
SEEN = 10
ORIGIN = np.array([0.55, 0.0, 0.6971])


def policy(
    path: Path,
    bias: FloatArray,
    matrix: FloatArray | None = None,
    opset: int = 17,
    width: int = SEEN,
) -> Path:
    """A policy that answers an affine function of what it sees."""
    weights = np.zeros((width, len(bias))) if matrix is None else matrix
    nodes = [helper.make_node("Gemm", ["state", "w", "b"], ["target"])]
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("state", TensorProto.FLOAT, ["N", width])],
        [helper.make_tensor_value_info("target", TensorProto.FLOAT, ["N", len(bias)])],
        [
            numpy_helper.from_array(np.asarray(weights, np.float32), "w"),
            numpy_helper.from_array(np.asarray(bias, np.float32), "b"),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)])
    model.ir_version = 8
    onnx.save(model, path)
    return path


def made(folder: Path, text: str, file: Path) -> Bundle:
    describe = folder / "policy.toml"
    describe.write_text(text)
    return load_bundle(write_foreign(file, Description(describe), TASK, folder / "bundle"))


def state() -> tuple[FloatArray, list[FloatArray]]:
    scene = TASK.sample_layout(np.random.default_rng(1), "reference")
    tips = list(start_waypoint(CELL).T_task_tip)
    return TASK.observe(tips, (0.3, 0.0), scene), tips


def test_a_policy_sees_the_stretches_that_it_asks_for_in_its_frame(tmp_path: Path) -> None:
    echo = np.eye(SEEN)
    text = GOOD.replace('"absolute"\ndisplacement', '"setpoint"\ndisplacement').replace(
        'rotation = "absolute"', 'rotation = "increment"'
    )
    bundle = made(tmp_path, text.replace('"angle"', '"binary"'), policy(
        tmp_path / "p.onnx", np.zeros(SEEN), echo
    ))  # fmt: skip
    seen, tips = state()
    goal = np.arange(8) / 100.0
    told = bundle.skills["grasp"](seen, goal)
    label = Label("surrol", "jaw-end")
    ends = [from_task(CELL, i, label, T)[:3, 3] for i, T in enumerate(tips)]
    thing = 5.0 * (seen[14:17] + ORIGIN)
    wished = [*ends[1], *(thing - ends[0]), 0.3, *(5.0 * (goal[3:6] + ORIGIN))]
    assert told == pytest.approx(wished, abs=1e-5)


def answer(bundle: Bundle) -> FloatArray:
    seen, _ = state()
    return bundle.skills["handover"](seen, np.zeros(8))


@pytest.mark.parametrize("far", [1.0, 10.0])
def test_an_absolute_target_becomes_the_waypoint_that_it_means(tmp_path: Path, far: float) -> None:
    _, tips = state()
    ways = [np.array([0.003, -0.004, 0.002]) * far, np.array([0.001, 0.002, -0.003]) * far]
    targets, label = [], Label("surrol", "jaw-end")
    for index, (T, way) in enumerate(zip(tips, ways, strict=True)):
        moved = T.copy()
        moved[:3, 3] += way
        place = from_task(CELL, index, label, moved)[:3, 3]
        yaw = yaw_of(T) + (0.2 if index == 0 else -0.3 + 2 * math.pi)
        targets += [*place, yaw, 0.59 if index == 0 else 0.1]
    bundle = made(tmp_path, GOOD, policy(tmp_path / "p.onnx", np.array(targets)))
    spec = bundle.manifest.action.spec()
    waypoint = apply_action(start_waypoint(CELL), answer(bundle), tips, CELL, spec)
    for index, (T, way) in enumerate(zip(tips, ways, strict=True)):
        step = waypoint.T_task_tip[index][:3, 3] - T[:3, 3]
        if far == 1.0:
            assert step == pytest.approx(way, abs=1e-6)
        inside = np.clip(T[:3, 3] + way, *_box(index)) - T[:3, 3]
        if np.allclose(inside, way):  # not held back by the workspace
            assert np.cross(step, way) == pytest.approx(np.zeros(3), abs=1e-7), "straight ahead"
        assert np.linalg.norm(step) <= 0.009 + 1e-9
        turned = yaw_of(waypoint.T_task_tip[index]) - yaw_of(T)
        assert math.remainder(turned, 2 * math.pi) == pytest.approx((0.2, -0.3)[index], abs=1e-5)
    assert waypoint.jaw == (0.6, CELL.arms[1].arm.jaw.grip_angle_rad)


def _box(arm: int) -> tuple[FloatArray, FloatArray]:
    entry = CELL.arms[arm].entry
    return np.array(entry.workspace_lower_m) + 0.003, np.array(entry.workspace_upper_m) - 0.003


def test_displacements_without_rotation_are_read_as_they_are(tmp_path: Path) -> None:
    text = GOOD.replace('reference = "absolute"', 'reference = "measured"')
    text = text.replace('rotation = "absolute"', 'rotation = "none"').replace('"angle"', '"binary"')
    bias = np.array([0.5, -0.25, 0.125, -1.0, 0.1, 0.2, 0.3, 1.0])
    told = answer(made(tmp_path, text, policy(tmp_path / "p.onnx", bias)))
    assert told == pytest.approx([0.5, -0.25, 0.125, 0, -1, 0.1, 0.2, 0.3, 0, 1], abs=1e-7)


def test_the_bundle_fits_its_task_and_says_what_is_not_known(tmp_path: Path) -> None:
    bundle = made(tmp_path, GOOD, policy(tmp_path / "p.onnx", np.zeros(10), opset=13))
    assert prepare(bundle.path).bundle.manifest.method == "onnx"
    assert set(bundle.skills) == {"grasp", "handover", "release"}
    assert "S29" in (bundle.path / "MODEL_CARD.md").read_text()


@pytest.mark.parametrize(
    ("change", "line", "match"),
    [
        (lambda t: t.replace("rate_hz = 5.0", "rate_hz = 20.0"), 3, "each 0.2 s: 5"),
        (lambda t: t.replace('["PSM1", "PSM2"]', '["PSM1"]'), 4, "PSM1, PSM2"),
        (lambda t: t.replace('006"]', '049"]'), 5, "large_needle"),
        (lambda t: t.replace('"surrol"', '"moon"'), 6, "surrol"),
        (lambda t: t.replace('"jaw-end"', '"tip"'), 7, "jaw-end"),
        (lambda t: t.replace('"psm1_jaw"', '"psm1_colour"'), 11, "no such stretch"),
        (lambda t: t.replace('"state"', '"vector"'), 10, "has state"),
        (lambda t: t.replace('"psm1_jaw", ', ""), 10, r"\[N, 9\]"),
        (lambda t: t.replace('"target"', '"motion"'), 14, "has target"),
        (lambda t: t.replace('rotation = "absolute"', 'rotation = "none"'), 14, r"\[N, 8\]"),
        (lambda t: t.replace("= 0.4", "= 30.0"), 19, "half a turn"),
        (lambda t: t.replace("= 0.008", "= -1.0"), 16, "greater than 0"),
        (
            lambda t: t.replace("displacement_m = 0.008", "displacment_m = 0.008"),
            16,
            "unknown|Field",
        ),
        (lambda t: t + "colour = 3\n", 22, "unknown entry"),
    ],
)
def test_what_does_not_fit_is_refused_with_its_line(
    tmp_path: Path, change: Callable[[str], str], line: int, match: str
) -> None:
    file = policy(tmp_path / "p.onnx", np.zeros(10))
    with pytest.raises(DataFileError, match=match) as caught:
        made(tmp_path, change(GOOD), file)
    if "displacment" not in change(GOOD):
        assert f"line {line}," in str(caught.value)
    assert not (tmp_path / "bundle").exists()


def test_files_that_are_no_policy_are_refused(tmp_path: Path) -> None:
    def refused(match: str, file: Path, text: str = GOOD) -> None:
        with pytest.raises(ViskillError, match=match):
            made(tmp_path, text, file)

    refused("opset 11", policy(tmp_path / "old.onnx", np.zeros(10), opset=11))
    (tmp_path / "bad.onnx").write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    refused("no usable ONNX", tmp_path / "bad.onnx")
    refused("no usable ONNX", tmp_path / "none.onnx")
    for name in ("policy.json", "policy.textproto", "policy.onnxtxt"):
        (tmp_path / name).write_text("{")
        refused("no usable ONNX", tmp_path / name)
    model = onnx.load(policy(tmp_path / "p.onnx", np.zeros(10)))
    onnx.save(
        model, tmp_path / "external.onnx", save_as_external_data=True, size_threshold=0,
        location="weights.bin",
    )  # fmt: skip
    refused("no usable ONNX|another file", tmp_path / "external.onnx")
    model = onnx.load(tmp_path / "p.onnx")
    extra = helper.make_tensor_value_info("memory", TensorProto.FLOAT, ["N", 3])
    model.graph.input.append(extra)
    onnx.save(model, tmp_path / "two.onnx")
    refused("also needs", tmp_path / "two.onnx")
    refused("cannot be read as TOML", tmp_path / "p.onnx", "schema = = 1")
    (tmp_path / "bundle").mkdir()
    (tmp_path / "bundle" / "mine").touch()
    with pytest.raises(BundleError, match="not an empty folder"):
        made(tmp_path, GOOD, tmp_path / "p.onnx")


def test_the_command_writes_a_bundle_and_tells_of_pivots_or_names_the_task_that_is_unknown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, describe = policy(tmp_path / "p.onnx", np.zeros(10)), tmp_path / "p.toml"
    describe.write_text(GOOD)
    bring.onnx(file, describe, tmp_path / "out")
    assert load_bundle(tmp_path / "out").manifest.name == "out"
    note = "note: subgoal.second_position: about the jaw pivot, as the task has it, not the jaw end"
    assert note in capsys.readouterr().out
    describe.write_text(GOOD.replace('"jaw-end"', '"jaw-pivot"'))
    bring.onnx(file, describe, tmp_path / "pivots")
    assert "note" not in capsys.readouterr().out
    describe.write_text(GOOD.replace('"bipegtransfer"', '"suturing"'))
    with pytest.raises(DataFileError, match="line 2, task: 'suturing' is unknown"):
        bring.onnx(file, describe, tmp_path / "other")
