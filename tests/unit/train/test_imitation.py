import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from viskill_deploy.bundle.format import check_fits, load_bundle
from viskill_deploy.core.errors import MotionError, TrainingError
from viskill_deploy.sim.closed_loop import ClosedLoop
from viskill_deploy.sim.tasks import load_task
from viskill_deploy.train import imitation
from viskill_deploy.train.checkpoint import CHECKPOINT, Checkpoint, load_checkpoint
from viskill_deploy.train.episodes import Request, run_episode, run_episodes, workers
from viskill_deploy.train.evaluate import evaluate
from viskill_deploy.train.export import check_graph, export
from viskill_deploy.train.imitation import Settings, graphs_of, train

TASK = load_task("bipegtransfer")
TINY = Settings(
    demonstrations=1,
    rounds=1,
    episodes=1,
    demonstration_updates=5,
    updates=5,
    final_updates=5,
    batch=16,
    script_share=0.0,
    disturbance=0.0,
    processes=1,
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Checkpoint, list[str]]:
    folder, said = tmp_path_factory.mktemp("run"), []
    return folder, train("bipegtransfer", 0, folder, TINY, said.append), said


def test_training_gathers_states_of_script_and_learner_and_tells_its_progress(
    run: tuple[Path, Checkpoint, list[str]],
) -> None:
    folder, state, said = run
    assert state.rounds_done == 2
    budgets = {skill.name: skill.budget for skill in TASK.skills}
    assert {name: len(data.obs) for name, data in state.data.items()} == {
        name: 2 * budget for name, budget in budgets.items()
    }
    lines = [json.loads(line) for line in (folder / "train.jsonl").read_text().splitlines()]
    assert [line["round"] for line in lines] == [0, 1]
    assert lines[1]["learner_episodes"] == 1
    assert len(said) == 2


def test_a_run_that_was_stopped_goes_on_to_the_same_end(
    run: tuple[Path, Checkpoint, list[str]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rounds = imitation._round

    def stops(*args: object) -> object:
        if args[2] == 1:
            raise KeyboardInterrupt
        return rounds(*args)  # type: ignore[arg-type]

    monkeypatch.setattr(imitation, "_round", stops)
    with pytest.raises(KeyboardInterrupt):
        train("bipegtransfer", 0, tmp_path, TINY, print)
    monkeypatch.undo()
    resumed = train("bipegtransfer", 0, tmp_path, TINY, print)
    for skill, layers in run[1].weights.items():
        for key, value in layers.items():
            assert np.array_equal(value, resumed.weights[skill][key])


def test_a_finished_run_is_not_trained_again(run: tuple[Path, Checkpoint, list[str]]) -> None:
    said: list[str] = []
    again = train("bipegtransfer", 0, run[0], TINY, said.append)
    assert said == []
    assert again.rounds_done == 2


def test_another_runs_folder_is_refused(run: tuple[Path, Checkpoint, list[str]]) -> None:
    with pytest.raises(TrainingError, match="empty folder"):
        train("bipegtransfer", 1, run[0], TINY, print)
    with pytest.raises(TrainingError, match="empty folder"):
        train("bipegtransfer", 0, run[0], replace(TINY, batch=17), print)


def test_a_damaged_checkpoint_is_refused(tmp_path: Path) -> None:
    (tmp_path / CHECKPOINT).write_bytes(b"PK\x03\x04 no archive")
    with pytest.raises(TrainingError, match="damaged"):
        load_checkpoint(tmp_path)


def test_an_exported_bundle_loads_and_fits_its_cell(
    run: tuple[Path, Checkpoint, list[str]], tmp_path: Path
) -> None:
    bundle = load_bundle(export(run[0], tmp_path / "bundle", episodes=0, say=print))
    check_fits(bundle, TASK.cell)
    manifest = bundle.manifest
    assert manifest.name == "bipegtransfer-imitation"
    assert [skill.name for skill in manifest.skills] == ["grasp", "handover", "release"]
    assert [skill.budget for skill in manifest.skills] == [45, 35, 20]
    assert manifest.measured == ()
    assert manifest.seeds == (0,)
    assert "Not measured." in (bundle.path / "MODEL_CARD.md").read_text(encoding="utf-8")
    obs = np.concatenate([data.obs for data in run[1].data.values()])
    assert np.array(manifest.training_range.lower) == pytest.approx(obs.min(axis=0))


def test_an_export_with_episodes_writes_down_what_was_measured(
    run: tuple[Path, Checkpoint, list[str]], tmp_path: Path
) -> None:
    bundle = load_bundle(export(run[0], tmp_path / "b", episodes=1, processes=1, say=print))
    entries = {entry.distribution: entry for entry in bundle.manifest.measured}
    assert set(entries) == {"reference", "wide"}
    assert entries["wide"].episodes == 1
    assert entries["wide"].success_rate == 0.0  # five updates teach nothing
    assert "--episodes 1" in entries["wide"].command


def test_a_graph_of_other_weights_is_refused(run: tuple[Path, Checkpoint, list[str]]) -> None:
    graphs = graphs_of(TASK, run[1].weights)
    assert check_graph(TASK, run[1], "grasp", graphs["grasp"]) <= 1e-6
    with pytest.raises(TrainingError, match="differs"):
        check_graph(TASK, run[1], "grasp", graphs["handover"])


def test_exporting_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="train first"):
        export(tmp_path, tmp_path / "bundle")


def test_the_script_scores_full_marks() -> None:
    score = evaluate(TASK, None, "wide", 2, seed=0)
    assert score.success_rate == 1.0
    assert score.skills == {"grasp": 1.0, "handover": 1.0, "release": 1.0}


def test_episodes_do_not_depend_on_who_ran_before_or_beside_them() -> None:
    requests = [Request("bipegtransfer", (1, i), "wide", (False,) * 3, 0.1) for i in range(2)]
    alone = run_episode(ClosedLoop(TASK), requests[1], {})
    for processes in (1, 2):
        with workers(processes) as pool:
            together = run_episodes(requests, {}, pool)[1]
        for one, other in zip(alone.skills, together.skills, strict=True):
            assert np.array_equal(one.obs, other.obs)
            assert np.array_equal(one.action, other.action)


def test_an_episode_that_no_motion_can_follow_ends_without_success(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    loop = ClosedLoop(TASK)

    def refuses(*_: object) -> None:
        raise MotionError("no motion")

    monkeypatch.setattr(loop, "plan", refuses)
    record = run_episode(loop, Request("bipegtransfer", (1,), "wide", (False,) * 3), {})
    assert record.skills == ()
    assert not record.success
