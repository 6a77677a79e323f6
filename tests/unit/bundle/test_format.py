"""A bundle is loaded as it was exported, or refused with the file and what to do."""

import json
import resource
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from untrained import linear_graph, misshapen_graph

from viskill_deploy.bundle import graphs
from viskill_deploy.bundle.chain import SkillChain
from viskill_deploy.bundle.format import MANIFEST, load_bundle, write_manifest
from viskill_deploy.bundle.format import Manifest as ManifestModel
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import BundleError
from viskill_deploy.core.sealed import sealed
from viskill_deploy.core.types import Scene, SkillStart
from viskill_deploy.motion.waypoints import ActionSpec
from viskill_deploy.runtime.preflight import check_fits

pytestmark = pytest.mark.invariant("S28")

Edit = Callable[[dict[str, Any]], None]
SCENE = Scene(0.0, (), "", np.zeros(3))


def edited(folder: Path, edit: Edit) -> None:
    """Changes the manifest and signs it again, as somebody with bad intentions would."""
    path = folder / MANIFEST
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(sealed(content))


def test_a_correct_bundle_loads_and_fits_its_cell(untrained_bundle: Path) -> None:
    bundle = load_bundle(untrained_bundle)
    assert bundle.manifest.observation_size == 35
    assert bundle.manifest.goal_size == 8
    assert set(bundle.skills) == {"grasp", "handover", "release"}
    assert not bundle.chaining
    assert not bundle.values
    check_fits(bundle, load_cell("bipegtransfer"))


def test_a_manifest_may_give_one_rotation_for_every_arm_or_one_an_arm(
    untrained_bundle: Path,
) -> None:
    def old(content: dict[str, Any]) -> None:  # as before arms could differ
        del content["action"]["pitch_rad"]

    edited(untrained_bundle, old)
    assert load_bundle(untrained_bundle).manifest.action.spec() == ActionSpec()
    edited(untrained_bundle, lambda c: c["action"].update(rotation=["pitch", "yaw"]))
    spec = load_bundle(untrained_bundle).manifest.action.spec()
    assert [spec.mode(arm) for arm in range(2)] == ["pitch", "yaw"]
    edited(untrained_bundle, lambda c: c["action"].update(rotation=["pitch"]))
    with pytest.raises(BundleError, match="rotation"):
        load_bundle(untrained_bundle)


@pytest.mark.parametrize("name", [MANIFEST, "skill-grasp.onnx", "MODEL_CARD.md"])
@pytest.mark.parametrize("where", [0.0, 0.3, 0.6, 0.999])
def test_a_changed_byte_is_found(untrained_bundle: Path, name: str, where: float) -> None:
    path = untrained_bundle / name
    content = bytearray(path.read_bytes())
    content[int(where * len(content))] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(BundleError) as caught:
        load_bundle(untrained_bundle)
    assert caught.value.exit_code == 3
    assert caught.value.path.name in {name, untrained_bundle.name}


@pytest.mark.parametrize("name", [MANIFEST, "skill-grasp.onnx"])
def test_a_truncated_file_is_found(untrained_bundle: Path, name: str) -> None:
    path = untrained_bundle / name
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(BundleError):
        load_bundle(untrained_bundle)


def test_swapped_graphs_are_found(untrained_bundle: Path) -> None:
    (untrained_bundle / "skill-grasp.onnx").write_bytes(linear_graph(gain=1.0))
    with pytest.raises(BundleError, match="SHA-256"):
        load_bundle(untrained_bundle)


@pytest.mark.parametrize("name", ["../outside.onnx", "/etc/passwd", "a/b.onnx", "..", ""])
def test_a_path_that_leaves_the_folder_is_refused(untrained_bundle: Path, name: str) -> None:
    (untrained_bundle.parent / "outside.onnx").write_bytes(linear_graph())
    edited(untrained_bundle, lambda m: m["files"].update({name: "0" * 64}))
    with pytest.raises(BundleError, match="leaves the bundle"):
        load_bundle(untrained_bundle)


def test_a_link_out_of_the_folder_is_refused(untrained_bundle: Path) -> None:
    graph = untrained_bundle / "skill-grasp.onnx"
    graph.rename(untrained_bundle.parent / "moved.onnx")
    graph.symlink_to(untrained_bundle.parent / "moved.onnx")
    with pytest.raises(BundleError, match="leaves the bundle"):
        load_bundle(untrained_bundle)


def test_an_unlisted_or_missing_file_is_refused(untrained_bundle: Path) -> None:
    extra = untrained_bundle / "weights.pkl"
    extra.write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    with pytest.raises(BundleError, match=r"weights\.pkl"):
        load_bundle(untrained_bundle)
    extra.unlink()
    (untrained_bundle / "skill-release.onnx").unlink()
    with pytest.raises(BundleError, match="missing"):
        load_bundle(untrained_bundle)


def replace_graph(folder: Path, graph: bytes) -> None:
    (folder / "skill-grasp.onnx").write_bytes(graph)
    content = json.loads((folder / MANIFEST).read_text())
    write_manifest(folder, ManifestModel.model_validate(content))


@pytest.mark.parametrize(
    "graph",
    [linear_graph(34), linear_graph(35, 7), linear_graph(35, 8, 5), linear_graph(43, 0, 10)],
    ids=["observation", "goal", "action", "no-goal"],
)
def test_a_graph_of_the_wrong_shape_is_refused(untrained_bundle: Path, graph: bytes) -> None:
    replace_graph(untrained_bundle, graph)
    with pytest.raises(BundleError, match=r"skill-grasp\.onnx"):
        load_bundle(untrained_bundle)


def test_a_pickle_or_a_zip_in_place_of_a_graph_is_never_executed(
    untrained_bundle: Path, tmp_path: Path
) -> None:
    canary = tmp_path / "canary"
    replace_graph(untrained_bundle, f"cos\nsystem\n(S'touch {canary}'\ntR.".encode())
    with pytest.raises(BundleError, match="ONNX"):
        load_bundle(untrained_bundle)
    assert not canary.exists()
    with zipfile.ZipFile(tmp_path / "bomb.zip", "w", zipfile.ZIP_DEFLATED) as bomb:
        bomb.writestr("zeros", bytes(10_000_000))
    replace_graph(untrained_bundle, (tmp_path / "bomb.zip").read_bytes())
    with pytest.raises(BundleError, match="ONNX"):
        load_bundle(untrained_bundle)


def drop(key: str) -> Edit:
    return lambda m: m.pop(key)


def put(key: str, value: Any) -> Edit:
    return lambda m: m.__setitem__(key, value)


BAD: dict[str, Edit] = {
    "newer schema": put("schema", 2),
    "unknown key": put("pickle", "weights.pkl"),
    "missing key": drop("skills"),
    "no skills": put("skills", []),
    "name that is a path": put("name", "x/../../evil"),
    "name that is markup": put("name", "mine [/v2]"),
    "name of nothing": put("name", ""),
    "endless name": put("name", "x" * 101),
    "negative step": put("step_s", -0.2),
    "other frame": put("frame", "world"),
    "scaled units": put("length_unit", "5m"),
    "short range": lambda m: m["training_range"]["lower"].pop(),
    "crossed range": lambda m: m["training_range"]["lower"].__setitem__(0, 8.0),
    "jaw per arm": lambda m: m["skills"][0].__setitem__("may_open_jaw", [True]),
    "zero budget": lambda m: m["skills"][0].__setitem__("budget", 0),
    "two of a name": lambda m: m["skills"][1].__setitem__("name", "grasp"),
    "unlisted graph": lambda m: m["skills"][0].__setitem__("file", "other.onnx"),
}


@pytest.mark.parametrize("edit", BAD.values(), ids=BAD.keys())
def test_a_manifest_that_makes_no_sense_is_refused(untrained_bundle: Path, edit: Edit) -> None:
    edited(untrained_bundle, edit)
    with pytest.raises(BundleError):
        load_bundle(untrained_bundle)


def test_a_manifest_with_nan_is_refused(untrained_bundle: Path) -> None:
    path = untrained_bundle / MANIFEST
    path.write_text(path.read_text().replace('"step_s": 0.2', '"step_s": NaN'))
    with pytest.raises(BundleError, match="NaN"):
        load_bundle(untrained_bundle)


def test_a_folder_without_manifest_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BundleError, match=r"manifest\.json"):
        load_bundle(tmp_path)


@pytest.mark.parametrize("key", ["robot", "tool", "name"])
def test_another_arm_or_tool_than_trained_with_is_refused(untrained_bundle: Path, key: str) -> None:
    edited(untrained_bundle, lambda m: m["arms"][1].__setitem__(key, "other"))
    bundle = load_bundle(untrained_bundle)
    with pytest.raises(BundleError, match="trained with"):
        check_fits(bundle, load_cell("bipegtransfer"))


def test_another_number_of_arms_or_another_cell_is_refused(untrained_bundle: Path) -> None:
    edited(untrained_bundle, put("cell", "elsewhere"))
    with pytest.raises(BundleError, match="cell"):
        check_fits(load_bundle(untrained_bundle), load_cell("bipegtransfer"))


def test_a_manifest_that_is_no_text_is_refused(untrained_bundle: Path) -> None:
    (untrained_bundle / MANIFEST).write_bytes(b"\xff\xfe{}")
    with pytest.raises(BundleError, match="readable"):
        load_bundle(untrained_bundle)


def test_a_chain_runs_each_skill_for_its_budget_with_its_own_subgoal(
    untrained_bundle: Path,
) -> None:
    asked: list[str] = []

    def subgoals(skill: str, observation: np.ndarray, scene: Scene) -> SkillStart:
        asked.append(skill)
        return SkillStart(skill, np.full(8, len(asked), dtype=float), "scripted")

    chain = SkillChain(load_bundle(untrained_bundle), subgoals)
    choices = []
    while not chain.finished:
        choices.append(chain.act(np.zeros(35), SCENE))
    assert asked == ["grasp", "handover", "release"]
    assert chain.steps == len(choices) == 100
    assert [c.step for c in choices[43:47]] == [43, 44, 0, 1]
    assert {c.start.subgoal[0] for c in choices[45:80]} == {2.0}
    assert {c.start.value for c in choices} == {None}
    assert choices[50].may_open_jaw == (False, True)
    assert all(c.action.shape == (10,) for c in choices)


def layered(nodes: list[onnx.NodeProto], tensors: list[TensorProto]) -> bytes:
    """A skill of the right signature, made of any nodes."""
    sizes = (("obs", 35), ("goal", 8))
    inputs = [helper.make_tensor_value_info(n, TensorProto.FLOAT, ["N", k]) for n, k in sizes]
    outputs = [helper.make_tensor_value_info("action", TensorProto.FLOAT, ["N", 10])]
    graph = helper.make_graph(nodes, "skill", inputs, outputs, tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    return bytes(model.SerializeToString())


@pytest.mark.parametrize(("rows", "columns"), [(1, 20), (1, 5), (0, 10), (2, 10)])
def test_a_graph_that_answers_in_another_shape_than_it_declares_is_refused(
    untrained_bundle: Path, rows: int, columns: int
) -> None:
    replace_graph(untrained_bundle, misshapen_graph((rows, columns), -1.0, 1.0))
    with pytest.raises(BundleError, match=rf"answers \[{rows}, {columns}\] .*declares \[N, 10\]"):
        load_bundle(untrained_bundle)


@pytest.mark.parametrize("place", ["weights.bin", "../run/weights.bin"])
def test_weights_that_lie_outside_the_graph_are_refused(
    untrained_bundle: Path, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = untrained_bundle.parent / "run"
    work.mkdir()
    np.ones((35, 10), np.float32).tofile(work / "weights.bin")
    monkeypatch.chdir(work)
    outside = TensorProto(name="w", data_type=TensorProto.FLOAT, dims=[35, 10])
    outside.data_location = TensorProto.EXTERNAL
    outside.external_data.add(key="location", value=place)
    replace_graph(
        untrained_bundle, layered([helper.make_node("MatMul", ["obs", "w"], ["action"])], [outside])
    )
    with pytest.raises(BundleError, match=r"skill-grasp\.onnx.*export it again"):
        load_bundle(untrained_bundle)


@pytest.mark.parametrize("numbers", [2**28, 2**34, 2**40])
def test_a_small_graph_that_asks_for_gigabytes_is_refused(
    untrained_bundle: Path, numbers: int
) -> None:
    nodes = [
        helper.make_node("ConstantOfShape", ["shape"], ["big"]),
        helper.make_node("ReduceSum", ["big"], ["sum"], keepdims=0),
        helper.make_node("MatMul", ["obs", "w"], ["y"]),
        helper.make_node("Add", ["y", "sum"], ["action"]),
    ]
    tensors = [
        numpy_helper.from_array(np.array([numbers]), "shape"),
        numpy_helper.from_array(np.zeros((35, 10), np.float32), "w"),
    ]
    before = resource.getrlimit(resource.RLIMIT_AS)
    replace_graph(untrained_bundle, layered(nodes, tensors))
    with pytest.raises(BundleError, match=r"cannot run|no usable"):
        load_bundle(untrained_bundle)
    assert resource.getrlimit(resource.RLIMIT_AS) == before


def test_where_memory_cannot_be_limited_graphs_are_opened_all_the_same(
    untrained_bundle: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(graphs, "STATM", untrained_bundle / "none")
    load_bundle(untrained_bundle)


def test_a_bundle_that_is_too_large_as_a_whole_is_refused(
    untrained_bundle: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("viskill_deploy.bundle.format.MAX_BUNDLE_BYTES", 4000)
    with pytest.raises(BundleError, match="larger than a bundle"):
        load_bundle(untrained_bundle)


def test_a_manifest_that_is_a_link_is_refused(untrained_bundle: Path) -> None:
    manifest = untrained_bundle / MANIFEST
    manifest.rename(untrained_bundle.parent / "elsewhere.json")
    manifest.symlink_to(untrained_bundle.parent / "elsewhere.json")
    with pytest.raises(BundleError, match="is a link"):
        load_bundle(untrained_bundle)
