"""A bundle is loaded as it was exported, or refused with the file and what to do."""

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.conftest import linear_graph
from viskill_deploy.bundle.chain import SkillChain
from viskill_deploy.bundle.format import MANIFEST, check_fits, digest, load_bundle, write_manifest
from viskill_deploy.bundle.format import Manifest as ManifestModel
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import BundleError
from viskill_deploy.motion.waypoints import ActionSpec

Edit = Callable[[dict[str, Any]], None]


def edited(folder: Path, edit: Edit) -> None:
    """Changes the manifest and signs it again, as somebody with bad intentions would."""
    path = folder / MANIFEST
    content = json.loads(path.read_text())
    edit(content)
    content["digest"] = digest(content)
    path.write_text(json.dumps(content))


def test_a_correct_bundle_loads_and_fits_its_cell(untrained_bundle: Path) -> None:
    bundle = load_bundle(untrained_bundle)
    assert bundle.manifest.observation_size == 35
    assert bundle.manifest.goal_size == 8
    assert set(bundle.sessions) == {"grasp", "handover", "release"}
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
    "negative step": put("step_s", -0.2),
    "other frame": put("frame", "world"),
    "scaled units": put("length_unit", "5m"),
    "short range": lambda m: m["training_range"]["lower"].pop(),
    "crossed range": lambda m: m["training_range"]["lower"].__setitem__(0, 2.0),
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

    def subgoals(skill: str, observation: np.ndarray) -> np.ndarray:
        asked.append(skill)
        return np.full(8, len(asked), dtype=float)

    chain = SkillChain(load_bundle(untrained_bundle), subgoals)
    choices = []
    while not chain.finished:
        choices.append(chain.act(np.zeros(35)))
    assert asked == ["grasp", "handover", "release"]
    assert chain.steps == len(choices) == 100
    assert [c.step for c in choices[43:47]] == [43, 44, 0, 1]
    assert {c.subgoal[0] for c in choices[45:80]} == {2.0}
    assert choices[50].may_open_jaw == (False, True)
    assert all(c.action.shape == (10,) for c in choices)
