"""Chaining and value graphs are loaded as exported or refused; subgoals come from them alone."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaining import VALUES, chain_graph, replace_file, resign, value_graph

from viskill_deploy.bundle.chain import SkillChain
from viskill_deploy.bundle.format import MANIFEST, Bundle, load_bundle
from viskill_deploy.bundle.subgoals import FAR_OUTSIDE_M, ChosenSubgoals, subgoal_source
from viskill_deploy.core.errors import BundleError, MotionError
from viskill_deploy.core.sealed import sealed
from viskill_deploy.core.types import Scene, SkillStart
from viskill_deploy.sim.closed_loop import ClosedLoop
from viskill_deploy.sim.tasks.base import load_task

TASK = load_task("bipegtransfer")
NEW = ("chain-grasp.onnx", "chain-handover.onnx", "value-grasp.onnx", "value-release.onnx")
NAN = float("nan")


@pytest.fixture(scope="module")
def seen() -> tuple[np.ndarray, Scene]:
    """The first observation of an episode, and its scene."""
    loop = ClosedLoop(TASK)
    observation = loop.reset(TASK.sample_layout(np.random.default_rng(0), "reference"))
    return observation, loop.world.scene()


def chain_of(bundle: Bundle) -> SkillChain:
    return SkillChain(bundle, subgoal_source(bundle, TASK, np.random.default_rng(0)))


def test_a_chaining_bundle_loads_with_a_graph_for_every_skill_that_needs_one(
    chaining_bundle: Path,
) -> None:
    bundle = load_bundle(chaining_bundle)
    assert set(bundle.skills) == {"grasp", "handover", "release"}
    assert set(bundle.chaining) == {"grasp", "handover"}
    assert set(bundle.values) == {"grasp", "handover", "release"}
    assert bundle.manifest.value is not None
    assert bundle.manifest.value.threshold == 0.5


@pytest.mark.parametrize("name", NEW)
@pytest.mark.parametrize("where", [0.0, 0.5, 0.999])
def test_a_changed_byte_is_found(chaining_bundle: Path, name: str, where: float) -> None:
    path = chaining_bundle / name
    content = bytearray(path.read_bytes())
    content[int(where * len(content))] ^= 1
    path.write_bytes(bytes(content))
    with pytest.raises(BundleError, match="SHA-256") as caught:
        load_bundle(chaining_bundle)
    assert caught.value.exit_code == 3
    assert caught.value.path.name == name


@pytest.mark.parametrize("name", NEW)
def test_a_missing_or_truncated_graph_is_found(chaining_bundle: Path, name: str) -> None:
    path = chaining_bundle / name
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(BundleError, match="SHA-256"):
        load_bundle(chaining_bundle)
    path.unlink()
    with pytest.raises(BundleError, match="missing"):
        load_bundle(chaining_bundle)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("chain-grasp.onnx", "chain-handover.onnx"),
        ("value-grasp.onnx", "value-handover.onnx"),
        ("chain-grasp.onnx", "value-grasp.onnx"),
        ("chain-grasp.onnx", "skill-grasp.onnx"),
    ],
)
def test_swapped_graphs_are_found(chaining_bundle: Path, one: str, other: str) -> None:
    first, second = chaining_bundle / one, chaining_bundle / other
    contents = first.read_bytes(), second.read_bytes()
    second.write_bytes(contents[0])
    first.write_bytes(contents[1])
    with pytest.raises(BundleError, match="SHA-256"):
        load_bundle(chaining_bundle)


@pytest.mark.parametrize(
    ("name", "graph"),
    [
        ("chain-grasp.onnx", chain_graph([0.0] * 8)),
        ("chain-grasp.onnx", chain_graph([0.0] * 6, observation=34)),
        ("chain-handover.onnx", chain_graph([0.0] * 6, goal=6)),
        ("chain-handover.onnx", value_graph(0.5)),
        ("value-grasp.onnx", value_graph(0.5, subgoal=6)),
        ("value-grasp.onnx", value_graph(0.5, size=2)),
        ("value-release.onnx", chain_graph([0.0] * 6)),
        ("value-release.onnx", b"no graph at all"),
    ],
    ids=["8-chosen", "observation", "goal", "value-as-chain", "subgoal", "2-values", "chain", "no"],
)
def test_a_graph_of_another_shape_is_refused(
    chaining_bundle: Path, name: str, graph: bytes
) -> None:
    replace_file(chaining_bundle, name, graph)
    with pytest.raises(BundleError) as caught:
        load_bundle(chaining_bundle)
    assert caught.value.path.name == name


def edited(folder: Path, edit: Callable[[dict[str, Any]], None]) -> None:
    """Changes the manifest and signs it again, unchecked."""
    path = folder / MANIFEST
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(sealed(content))


BAD: dict[str, Callable[[dict[str, Any]], Any]] = {
    "scripted with chaining": lambda m: m.__setitem__("subgoals", "scripted"),
    "chaining without graphs": lambda m: m.__setitem__("chaining", None),
    "another source": lambda m: m.__setitem__("subgoals", "oracle"),
    "no graph for a skill": lambda m: m["chaining"]["graphs"].pop("handover"),
    "a graph for the last skill": lambda m: m["chaining"]["graphs"].__setitem__(
        "release", "chain-release.onnx"
    ),
    "a skill's graph for another": lambda m: m["chaining"]["graphs"].__setitem__(
        "grasp", "chain-handover.onnx"
    ),
    "no value for the last skill": lambda m: m["value"]["graphs"].pop("release"),
    "a value of another skill": lambda m: m["value"]["graphs"].__setitem__(
        "grasp", "value-handover.onnx"
    ),
    "no threshold": lambda m: m["value"].pop("threshold"),
    "a threshold above one": lambda m: m["value"].__setitem__("threshold", 1.2),
    "a threshold below zero": lambda m: m["value"].__setitem__("threshold", -0.1),
    "an unlisted graph": lambda m: m["files"].pop("chain-grasp.onnx"),
    "unknown key": lambda m: m["chaining"].__setitem__("noise", 0.1),
}


@pytest.mark.parametrize("edit", BAD.values(), ids=BAD.keys())
def test_a_manifest_whose_chaining_makes_no_sense_is_refused(
    chaining_bundle: Path, edit: Callable[[dict[str, Any]], None]
) -> None:
    edited(chaining_bundle, edit)
    with pytest.raises(BundleError):
        load_bundle(chaining_bundle)


def test_a_graph_that_is_named_but_not_listed_is_refused_by_name(chaining_bundle: Path) -> None:
    (chaining_bundle / "value-grasp.onnx").unlink()
    edited(chaining_bundle, lambda m: m["files"].pop("value-grasp.onnx"))
    with pytest.raises(BundleError, match=r"value-grasp\.onnx: is named but not listed"):
        load_bundle(chaining_bundle)


def test_a_value_may_stand_beside_scripted_subgoals_and_chaining_without_a_value(
    chaining_bundle: Path, seen: tuple[np.ndarray, Scene]
) -> None:
    for path in chaining_bundle.glob("chain-*.onnx"):
        path.unlink()
    resign(chaining_bundle, subgoals="scripted", chaining=None)
    start = chain_of(load_bundle(chaining_bundle)).act(*seen).start
    assert (start.source, start.value) == ("scripted", pytest.approx(VALUES["grasp"]))
    for path in chaining_bundle.glob("value-*.onnx"):
        path.unlink()
    resign(chaining_bundle, value=None)
    assert chain_of(load_bundle(chaining_bundle)).act(*seen).start.value is None


def test_subgoals_and_values_are_decided_at_the_first_step_of_each_skill_alone(
    chaining_bundle: Path, seen: tuple[np.ndarray, Scene]
) -> None:
    observation, scene = seen
    chain, rng = chain_of(load_bundle(chaining_bundle)), np.random.default_rng(1)
    starts, at = [], []
    while not chain.finished:
        at.append(observation + rng.normal(0.0, 1e-3, len(observation)))
        starts.append(chain.act(at[-1], scene).start)
    assert len(set(map(id, starts))) == 3
    grasp, handover, release = starts[0], starts[45], starts[80]
    assert [s.source for s in (grasp, handover, release)] == ["chaining", "chaining", "task"]
    assert [s.value for s in (grasp, handover, release)] == pytest.approx(list(VALUES.values()))
    # affine in what was seen at the first step of the skill, and of nothing else
    np.testing.assert_allclose(handover.subgoal[:2], at[45][29:31] - [0, at[45][15]], atol=1e-6)
    np.testing.assert_array_equal(handover.subgoal[6:], [1.0, 0.0])
    np.testing.assert_array_equal(release.subgoal, TASK.final_subgoal(at[80], scene))


def test_a_chaining_bundle_never_asks_for_the_scripted_plan(
    chaining_bundle: Path, seen: tuple[np.ndarray, Scene], monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*args: object) -> None:
        raise AssertionError("the plan is hidden")

    monkeypatch.setattr(type(TASK), "subgoals", never)
    bundle, rng = load_bundle(chaining_bundle), np.random.default_rng(0)
    before = rng.bit_generator.state
    chain = SkillChain(bundle, subgoal_source(bundle, TASK, rng))
    while not chain.finished:
        chain.act(*seen)
    assert rng.bit_generator.state == before


def test_what_is_chosen_depends_on_the_goal(
    chaining_bundle: Path, seen: tuple[np.ndarray, Scene]
) -> None:
    observation, scene = seen
    choose = ChosenSubgoals(load_bundle(chaining_bundle), TASK)
    moved = Scene(0.0, scene.objects, scene.active, scene.goal + np.array([0.01, 0, 0]))
    here = choose("handover", observation, scene).subgoal
    there = choose("handover", observation, moved).subgoal
    np.testing.assert_allclose(there - here, [0, 0, 0, 0.003, 0, 0, 0, 0], atol=1e-7)


@pytest.mark.parametrize("wrong", [NAN, np.inf, -np.inf])
@pytest.mark.parametrize("entry", [0, 5])
def test_a_chosen_subgoal_that_is_not_finite_is_refused(
    chaining_bundle: Path, seen: tuple[np.ndarray, Scene], wrong: float, entry: int
) -> None:
    bias = [0.0, 0.0, 0.05] * 2
    bias[entry] = wrong
    replace_file(chaining_bundle, "chain-grasp.onnx", chain_graph(bias))
    with pytest.raises(MotionError, match="'grasp' is not finite"):
        chain_of(load_bundle(chaining_bundle)).act(*seen)


INSIDE = np.array([0.0, 0.0, 0.05])
LOW, HIGH = np.array([-0.057, -0.057, -0.0039]), np.array([0.057, 0.057, 0.0771])
"""The box around both arms' workspaces in the cell's file."""


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", ["low", "high"])
def test_a_chosen_subgoal_far_outside_the_workspace_is_refused_with_how_far(
    chaining_bundle: Path, seen: tuple[np.ndarray, Scene], which: int, axis: int, side: str
) -> None:
    def choose(outside: float) -> list[float]:
        points = [INSIDE.copy(), INSIDE.copy()]
        edge = LOW[axis] - outside if side == "low" else HIGH[axis] + outside
        points[which][axis] = edge
        return [*points[0], *points[1]]

    replace_file(chaining_bundle, "chain-grasp.onnx", chain_graph(choose(FAR_OUTSIDE_M - 1e-5)))
    start = chain_of(load_bundle(chaining_bundle)).act(*seen).start
    assert start.source == "chaining"
    replace_file(chaining_bundle, "chain-grasp.onnx", chain_graph(choose(0.031)))
    with pytest.raises(MotionError, match=re.escape("31.0 mm outside the workspace")) as caught:
        chain_of(load_bundle(chaining_bundle)).act(*seen)
    assert "'grasp'" in str(caught.value)
    assert "train the chaining policy again" in str(caught.value)


def test_scaled_units_are_found(chaining_bundle: Path, seen: tuple[np.ndarray, Scene]) -> None:
    replace_file(chaining_bundle, "chain-grasp.onnx", chain_graph([*(5 * INSIDE), *(5 * INSIDE)]))
    with pytest.raises(MotionError, match="outside the workspace"):
        chain_of(load_bundle(chaining_bundle)).act(*seen)


@pytest.mark.parametrize("value", [NAN, np.inf, -0.01, 1.01])
def test_a_value_that_is_no_probability_is_refused(
    chaining_bundle: Path, seen: tuple[np.ndarray, Scene], value: float
) -> None:
    replace_file(chaining_bundle, "value-grasp.onnx", value_graph(value))
    with pytest.raises(MotionError, match=r"'grasp' is .* no probability"):
        chain_of(load_bundle(chaining_bundle)).act(*seen)


@pytest.mark.parametrize(("raw", "told"), [(0.0, 0.0), (1.0, 1.0), (1.0000001, 1.0)])
def test_a_value_at_the_edge_passes(
    chaining_bundle: Path, seen: tuple[np.ndarray, Scene], raw: float, told: float
) -> None:
    replace_file(chaining_bundle, "value-grasp.onnx", value_graph(raw))
    assert chain_of(load_bundle(chaining_bundle)).act(*seen).start.value == told


def test_what_was_decided_is_frozen_and_finite() -> None:
    start = SkillStart("grasp", np.zeros(8), "chaining")
    with pytest.raises(ValueError, match="read-only"):
        start.subgoal[0] = 1.0
    with pytest.raises(ValueError, match="not finite"):
        SkillStart("grasp", np.full(8, NAN), "chaining")


def test_a_graph_runs_rows_of_any_number(chaining_bundle: Path) -> None:
    session = load_bundle(chaining_bundle).chaining["grasp"].session
    feed = {"obs": np.zeros((7, 35), np.float32), "task_goal": np.zeros((7, 3), np.float32)}
    assert session.run(["subgoal"], feed)[0].shape == (7, 6)


def test_a_graph_that_cannot_run_is_named(chaining_bundle: Path) -> None:
    graph = load_bundle(chaining_bundle).chaining["grasp"]
    with pytest.raises(BundleError, match=r"chain-grasp\.onnx: cannot run"):
        graph(np.zeros(34), np.zeros(3))
