"""Episodes whose subgoals the bundle chooses, closed loop and planned, and what refuses them."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from chaining import VALUES, chain_graph, replace_file, resign, value_graph
from untrained import misshapen_graph

from viskill_deploy.core.types import Boundary, SkillStart
from viskill_deploy.runtime.dry_run import DryRunOptions, dry_run
from viskill_deploy.runtime.episodes import Mode
from viskill_deploy.runtime.figures import Outcome
from viskill_deploy.runtime.preflight import prepare

pytestmark = pytest.mark.no_cover

SKILLS = ["grasp", "handover", "release"]
SOURCES = ["chaining", "chaining", "task"]
NAN = float("nan")


class Notebook:
    """A recorder that remembers what was decided at the start of skills."""

    alive = True

    def __init__(self) -> None:
        self.starts: list[tuple[int, str, int, SkillStart]] = []
        self.sent: list[tuple[float, ...]] = []
        self.boundaries: list[Boundary] = []

    def cycle(self, *args: object) -> None:
        self.sent.append(tuple(x for s in args[3] for x in s.jp))  # type: ignore[attr-defined]

    def scene(self, *args: object) -> None:
        pass

    def mark(
        self,
        now: float,
        episode: int,
        skill: str,
        step: int,
        note: str = "",
        start: SkillStart | None = None,
        boundary: Boundary | None = None,
    ) -> None:
        if boundary is not None:
            self.boundaries.append(boundary)
        if start is not None:
            self.starts.append((episode, skill, step, start))


def run(bundle: Path, mode: Mode = "closed-loop", episodes: int = 1) -> tuple[Outcome, Notebook]:
    notebook = Notebook()
    options = DryRunOptions(episodes=episodes, mode=mode, distribution="reference")
    return dry_run(prepare(bundle), options, notebook), notebook


@pytest.fixture
def copy(affinely_chained: Path, tmp_path: Path) -> Path:
    """A bundle that does the task, to be spoiled."""
    return shutil.copytree(affinely_chained, tmp_path / "copy")


@pytest.mark.parametrize("mode", ["closed-loop", "plan"])
def test_the_task_is_done_with_chosen_subgoals_and_every_start_is_told(
    affinely_chained: Path, mode: Mode
) -> None:
    outcome, notebook = run(affinely_chained, mode)
    figures = outcome.figures
    assert outcome.failure is None
    assert figures["success_rate"] == 1.0
    assert figures["interventions"] == 0
    assert (figures["subgoals"], figures["value_threshold"]) == ("chaining", 0.5)
    (episode,) = figures["episode_results"]
    assert [s["name"] for s in episode["skills"]] == SKILLS
    assert [s["steps"] for s in episode["skills"]] == [45, 35, 20]
    assert [s["success"] for s in episode["skills"]] == [True] * 3
    assert [s["subgoal_source"] for s in episode["skills"]] == SOURCES
    assert [s["value"] for s in episode["skills"]] == pytest.approx(list(VALUES.values()))
    assert [(skill, step) for _, skill, step, _ in notebook.starts] == [(s, 0) for s in SKILLS]
    for told, (_, _, _, start) in zip(episode["skills"], notebook.starts, strict=True):
        np.testing.assert_array_equal(told["subgoal"], start.subgoal)
        assert sum(part["size"] for part in figures["subgoal_layout"]) == len(told["subgoal"])


def test_a_scripted_bundle_tells_its_subgoals_too_and_no_value(unchained: Path) -> None:
    outcome, notebook = run(unchained)
    (episode,) = outcome.figures["episode_results"]
    assert {s["subgoal_source"] for s in episode["skills"]} == {"scripted"}
    assert {s["value"] for s in episode["skills"]} == {None}
    assert outcome.figures["value_threshold"] is None
    assert len(notebook.starts) == 3


@pytest.mark.parametrize("wrong", [NAN, 0.2], ids=["nan", "outside"])
def test_a_first_subgoal_that_is_refused_moves_nothing_and_says_why(
    copy: Path, wrong: float
) -> None:
    replace_file(copy, "chain-grasp.onnx", chain_graph([wrong, 0.0, 0.05, 0.0, 0.0, 0.05]))
    outcome, notebook = run(copy, episodes=2)
    assert outcome.failure is None, "the next episode is run"
    for episode in outcome.figures["episode_results"]:
        assert not episode["success"]
        assert episode["stopped_by"] == "S16"
        assert "the subgoal chosen for 'grasp'" in episode["reason"]
        assert episode["skills"] == []
    assert notebook.starts == []
    assert np.ptp(np.array(notebook.sent), axis=0).max() < 1e-9


def test_a_later_subgoal_that_is_refused_brings_the_arms_to_rest(copy: Path) -> None:
    replace_file(copy, "chain-handover.onnx", chain_graph([NAN] * 6))
    outcome, notebook = run(copy)
    (episode,) = outcome.figures["episode_results"]
    assert [s["name"] for s in episode["skills"]] == ["grasp"]
    assert episode["skills"][0]["success"] is True
    assert episode["stopped_by"] == "S16"
    assert "'handover' is not finite" in episode["reason"]
    assert np.abs(np.diff(notebook.sent[-2:], axis=0)).max() < 1e-9


def test_a_value_that_is_no_number_stops_the_episode_like_a_bad_subgoal(copy: Path) -> None:
    replace_file(copy, "value-grasp.onnx", value_graph(NAN))
    outcome, notebook = run(copy)
    (episode,) = outcome.figures["episode_results"]
    assert episode["stopped_by"] == "S16"
    assert "no probability" in episode["reason"]
    assert np.ptp(np.array(notebook.sent), axis=0).max() < 1e-9


@pytest.mark.parametrize("answer", [(1, 5), (1, 20), (0, 10)], ids=str)
def test_an_answer_of_another_shape_in_the_middle_of_a_skill_brings_the_arms_to_rest(
    unchained: Path, tmp_path: Path, answer: tuple[int, int]
) -> None:
    bundle = shutil.copytree(unchained, tmp_path / "misshapen")
    replace_file(bundle, "skill-grasp.onnx", misshapen_graph(answer, 0.01, 0.05))
    outcome, notebook = run(bundle)
    (episode,) = outcome.figures["episode_results"]
    assert outcome.failure is None
    assert (episode["success"], episode["stopped_by"]) == (False, "S16")
    assert f"skill-grasp.onnx: answers [{answer[0]}, {answer[1]}]" in episode["reason"]
    assert episode["skills"][0]["steps"] >= 2
    assert np.ptp(np.array(notebook.sent), axis=0).max() > 1e-3, "the arms were moving"
    assert np.abs(np.diff(notebook.sent[-2:], axis=0)).max() < 1e-9


@pytest.mark.parametrize("graph", ["chain-grasp.onnx", "chain-handover.onnx", "value-release.onnx"])
def test_in_plan_mode_nothing_moves_at_all(copy: Path, graph: str) -> None:
    bad = value_graph(NAN) if graph.startswith("value") else chain_graph([NAN] * 6)
    replace_file(copy, graph, bad)
    outcome, notebook = run(copy, "plan")
    (episode,) = outcome.figures["episode_results"]
    assert not episode["success"]
    assert graph.removesuffix(".onnx").split("-")[1] in episode["refused"]
    assert notebook.sent == []


@pytest.mark.parametrize("mode", ["closed-loop", "plan"])
def test_with_a_low_value_at_the_start_nothing_moves(copy: Path, mode: Mode) -> None:
    replace_file(copy, "value-grasp.onnx", value_graph(0.2))
    outcome, notebook = run(copy, mode)
    (episode,) = outcome.figures["episode_results"]
    assert outcome.failure is None
    assert (episode["success"], episode["stopped_by"], episode["skills"]) == (False, "", [])
    (boundary,) = notebook.boundaries
    assert (boundary.course, boundary.value) == ("safe pose", pytest.approx(0.2))
    assert np.ptp(np.array(notebook.sent), axis=0).max() < 1e-6


def test_with_a_low_value_a_skill_is_tried_again_and_then_the_arms_go_to_their_start_pose(
    copy: Path,
) -> None:
    replace_file(copy, "value-handover.onnx", value_graph(0.2))
    outcome, notebook = run(copy)
    (episode,) = outcome.figures["episode_results"]
    assert outcome.figures["interventions"] == 0
    assert not episode["success"]
    assert [s["name"] for s in episode["skills"]] == ["grasp", "grasp"]
    assert [(b.before, b.course) for b in notebook.boundaries] == [
        ("grasp", "go on"),
        ("handover", "retry"),
        ("grasp", "go on"),
        ("handover", "safe pose"),
    ]
    assert episode["retries"] == 1
    assert all(grasp.holds for b in notebook.boundaries for grasp in b.grasps)
    np.testing.assert_allclose(notebook.sent[-1], notebook.sent[0], atol=1e-3)


def test_a_chaining_bundle_without_value_runs(copy: Path) -> None:
    for path in copy.glob("value-*.onnx"):
        path.unlink()
    resign(copy, value=None)
    outcome, _ = run(copy)
    assert outcome.figures["success_rate"] == 1.0
    assert {s["value"] for s in outcome.figures["episode_results"][0]["skills"]} == {None}
