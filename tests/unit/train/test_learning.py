"""A tiny training from demonstrations to a bundle: whole, resumed, and repeated."""

import dataclasses
import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from viskill_deploy.bundle.format import load_bundle
from viskill_deploy.cli.main import app
from viskill_deploy.core.errors import TrainingError
from viskill_deploy.core.types import Scene
from viskill_deploy.sim.vector_loop import VectorLoop
from viskill_deploy.train import methods, store
from viskill_deploy.train.calibration import calibrate
from viskill_deploy.train.chain_learning import ChainAmounts, Chained, ChainLearner
from viskill_deploy.train.chaining import Chaining, ChainSettings
from viskill_deploy.train.demos import DemoSettings, record_demos
from viskill_deploy.train.dex import DexSettings
from viskill_deploy.train.evaluate import evaluate
from viskill_deploy.train.export import check_place, export, load_trained
from viskill_deploy.train.rollout import fresh, run_task
from viskill_deploy.train.run import (
    Run,
    actor,
    demos_of,
    finish_skill,
    skill_learner,
    skills_of,
)
from viskill_deploy.train.settings import RunSettings
from viskill_deploy.train.skill_learning import SkillData, SkillLearner, SkillSettings

TINY = RunSettings(
    environments=4,
    demos=DemoSettings(episodes=4, corrected=4),
    skill=SkillSettings(
        imitation_steps=4,
        corrections=1,
        polish_steps=2,
        rounds=1,
        updates=2,
        test_every=1,
        passes=9,
        ends=4,
    ),
    dex=DexSettings(batch=16, hidden=16, critic_first=1),
    chain=ChainSettings(batch=16, hidden=16),
    amounts=ChainAmounts(planned_rounds=1, rounds=3, updates=1, planned_updates=2, test_every=1),
)


def quiet(_: str) -> None:
    pass


def run_in(folder: Path, seed: int = 0) -> Run:
    return Run(folder, "bipegtransfer", seed, TINY, quiet)


def arrays(tree: object) -> list[np.ndarray]:
    if isinstance(tree, np.ndarray):
        return [tree]
    if isinstance(tree, dict):
        return [a for key in sorted(tree) for a in arrays(tree[key])]
    return [a for item in tree for a in arrays(item)] if isinstance(tree, list) else []


def same(a: Path, b: Path) -> bool:
    one, two = arrays(store.load(a)), arrays(store.load(b))
    return len(one) == len(two) and all(np.array_equal(x, y) for x, y in zip(one, two, strict=True))


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Run:
    run = run_in(tmp_path_factory.mktemp("run"))
    methods.learn("viskill", run)
    return run


def test_every_stage_leaves_its_result_and_nothing_half_done(trained: Run) -> None:
    names = {path.name for path in trained.folder.glob("*.npz")}
    skills = {f"skill-{name}.npz" for name in ("grasp", "handover", "release")}
    assert names == {"demos.npz", "chain-viskill.npz", *skills}
    lines = [json.loads(line) for line in (trained.folder / "log.jsonl").read_text().splitlines()]
    grasp = [line for line in lines if line["stage"] == "skill-grasp" and "round" in line]
    assert [line["round"] for line in grasp] == [0, 1, 2]


def test_demonstrations_are_whole_episodes_that_the_script_finished(trained: Run) -> None:
    for skill, demos in zip(trained.task.skills, demos_of(trained), strict=True):
        assert demos.clean.action.shape[1:] == (skill.budget, 10)
        ends = trained.task.skill_success(skill.name, demos.clean.achieved[:, -1], demos.clean.goal)
        assert ends.all()
        assert len(demos.clean) == len(demos.starts) >= 4


def test_a_broken_run_goes_on_to_the_same_bits(trained: Run, tmp_path: Path) -> None:
    """Each call starts anew from the files, as after kill -9, and does one round or stage."""
    again = run_in(tmp_path)
    store.save(tmp_path / "demos.npz", store.load(trained.folder / "demos.npz"))
    for _ in range(2):
        fresh = run_in(tmp_path)
        learner = skill_learner(fresh, 0, ())
        state = tmp_path / "skill-grasp.state.npz"
        if state.is_file():
            learner.restore(store.load(state))
        learner.advance()
        store.save(state, learner.state())
    skills_of(again)
    assert not list(tmp_path.glob("*.state.npz"))
    for name in ("skill-grasp", "skill-handover", "skill-release"):
        assert same(trained.folder / f"{name}.npz", tmp_path / f"{name}.npz")


def test_the_same_seed_gives_the_same_bits_and_another_one_does_not(
    trained: Run, tmp_path: Path
) -> None:
    for path in trained.folder.glob("*.npz"):
        if path.name != "chain-viskill.npz":
            store.save(tmp_path / path.name, store.load(path))
    methods.learn("viskill", run_in(tmp_path))
    assert same(trained.folder / "chain-viskill.npz", tmp_path / "chain-viskill.npz")
    other = run_in(tmp_path / "other", seed=1)
    mine, theirs = demos_of(trained)[0].clean.obs, demos_of(other)[0].clean.obs
    assert not np.array_equal(mine, theirs)


def test_a_broken_chain_goes_on_to_the_same_bits(trained: Run, tmp_path: Path) -> None:
    for path in trained.folder.glob("*.npz"):
        if path.name != "chain-viskill.npz":
            store.save(tmp_path / path.name, store.load(path))
    run = run_in(tmp_path)
    acts = [actor(run, skill["weights"]) for skill in skills_of(run)]
    chaining = Chaining(run.task, TINY.chain, run.seed)
    learner = ChainLearner(run.loop, acts, chaining, TINY.distributions, TINY.amounts, run.seed)
    learner.advance()
    learner.advance()
    store.save(tmp_path / "chain-viskill.state.npz", learner.state())
    methods.learn("viskill", run_in(tmp_path))
    assert same(trained.folder / "chain-viskill.npz", tmp_path / "chain-viskill.npz")


ELSEWHERE = """
import sys
sys.path[:0] = {paths!r}
from pathlib import Path
from test_learning import run_in
from viskill_deploy.train.run import demos_of
demos_of(run_in(Path({folder!r})))
"""


def test_another_process_records_the_same_demonstrations(trained: Run, tmp_path: Path) -> None:
    """Nothing random or of an unsettled order is left to the process."""
    code = ELSEWHERE.format(paths=sys.path, folder=str(tmp_path))
    hashes = {**os.environ, "PYTHONHASHSEED": "12345"}
    subprocess.run([sys.executable, "-c", code], check=True, env=hashes)
    assert same(trained.folder / "demos.npz", tmp_path / "demos.npz")


def test_gradient_steps_have_one_thread_whatever_physics_has(tmp_path: Path) -> None:
    """The same network sums in another order, to other bits, where there are more."""
    Run(tmp_path, "bipegtransfer", 0, TINY, quiet, threads=2)
    assert torch.get_num_threads() == 1


def test_a_stage_names_the_code_that_its_process_began_with(
    trained: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    began = run_in(tmp_path).commit
    monkeypatch.setattr("viskill_deploy.train.provenance.commit", lambda: "of another day")
    run = run_in(tmp_path)
    run.finish("counting", {})
    told = json.loads((tmp_path / "log.jsonl").read_text().splitlines()[-1])
    assert told == {"stage": "counting", "commit": began}


def test_a_skill_that_never_ends_whole_is_told_of(
    trained: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = without_chain(trained, tmp_path)
    monkeypatch.setattr("viskill_deploy.train.run.saved", lambda *_: [])
    learner = skill_learner(run, 0, ())
    with pytest.raises(TrainingError, match="every episode of grasp broke off"):
        finish_skill(run, "skill-grasp", learner)


def test_a_diverged_network_is_never_the_best_one(trained: Run, tmp_path: Path) -> None:
    learner = skill_learner(without_chain(trained, tmp_path), 0, ())
    learner.examiner = lambda *_: 0.0
    learner._test()
    sound = learner.best_weights()
    with torch.no_grad():
        learner.agent.actor.layers[0].weight[0, 0] = float("nan")
    learner._test()
    assert all(np.isfinite(value).all() for value in learner.best_weights().values())
    assert learner.best_weights().keys() == sound.keys()


def test_a_folder_with_other_settings_is_refused(trained: Run) -> None:
    settings = dataclasses.replace(TINY, environments=5)
    with pytest.raises(TrainingError, match="name an empty folder"):
        Run(trained.folder, "bipegtransfer", 0, settings, quiet)


def without_chain(trained: Run, folder: Path) -> Run:
    """A run with the demonstrations and skills of another one."""
    for name in ("demos", "skill-grasp", "skill-handover", "skill-release"):
        store.save(folder / f"{name}.npz", store.load(trained.folder / f"{name}.npz"))
    return run_in(folder)


@pytest.mark.parametrize("method", ["viskill_sr", "viskill_dm", "viskill_ldm", "self_imitation"])
def test_every_ablation_learns_another_chain_over_the_same_skills(
    trained: Run, method: str, tmp_path: Path
) -> None:
    run = without_chain(trained, tmp_path)
    policy = methods.learn(method, run)
    assert {path.stem for path in tmp_path.glob("*.npz")} == {
        *("demos", "skill-grasp", "skill-handover", "skill-release", f"chain-{method}")
    }
    for name in ("skill-grasp", "skill-handover", "skill-release"):
        assert same(trained.folder / f"{name}.npz", tmp_path / f"{name}.npz")
    assert not same(trained.folder / "chain-viskill.npz", tmp_path / f"chain-{method}.npz")
    assert evaluate(run.loop, policy, "reference", 4, 0).episodes == 4


def test_scripted_subgoals_need_nothing_but_skills(trained: Run, tmp_path: Path) -> None:
    run = without_chain(trained, tmp_path)
    policy = methods.learn("planned", run)
    assert len(list(tmp_path.glob("*.npz"))) == 4
    chosen = []
    for _ in range(2):
        fresh(run.loop, np.random.default_rng(0), ("reference",))
        chosen.append(run_task(run.loop, policy).subgoal)
    assert np.array_equal(*chosen)


def rounds_of(run: Run, stage: str) -> list[dict[str, float]]:
    lines = [json.loads(line) for line in (run.folder / "log.jsonl").read_text().splitlines()]
    return [line for line in lines if line["stage"] == stage and "round" in line]


def test_flat_dex_explores_as_long_as_skills_and_chain(trained: Run, tmp_path: Path) -> None:
    run = without_chain(trained, tmp_path)
    methods.learn("dex", run)
    rounds = rounds_of(run, "dex")
    kinds = ["imitation" in line for line in rounds]
    explored = TINY.skill.corrections + TINY.skill.rounds + TINY.amounts.rounds
    assert kinds == [True] + [False] * explored
    assert "success" in rounds[0]
    assert "success" in rounds[-1]


def test_gcbc_imitates_demonstrations_alone(trained: Run, tmp_path: Path) -> None:
    run = without_chain(trained, tmp_path)
    methods.learn("gcbc", run)
    (line,) = rounds_of(run, "gcbc")
    assert "imitation" in line and "exploring" not in line


def test_tstar_trains_every_skill_on_as_long_as_the_chain_and_goes_on_to_the_same_bits(
    trained: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    run = without_chain(trained, whole)
    methods.learn("tstar", run)
    for name in ("grasp", "handover", "release"):
        rounds = rounds_of(run, f"tstar-{name}")
        assert len(rounds) == TINY.amounts.rounds
        assert not any("imitation" in line for line in rounds)

    def log(run: Run, line: dict[str, object]) -> None:
        if line["stage"] == "tstar-handover" and line.get("round") == 3:
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Run, "log", log)
        with pytest.raises(KeyboardInterrupt):
            methods.learn("tstar", without_chain(trained, broken))
    assert (broken / "tstar-handover.state.npz").is_file()
    methods.learn("tstar", run_in(broken))
    for name in ("grasp", "handover", "release"):
        assert same(whole / f"tstar-{name}.npz", broken / f"tstar-{name}.npz")


class SeenError(Exception):
    """Carries what was seen."""


def test_layouts_of_learning_selection_and_measuring_are_apart(
    trained: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def reset(loop: VectorLoop, scenes: dict[int, Scene]) -> None:
        raise SeenError([thing.T_task_object for thing in scenes[0].objects])

    layouts, policy = [], methods.learn("viskill", Run.open(trained.folder, quiet))
    assert isinstance(policy, Chained)
    monkeypatch.setattr(VectorLoop, "reset", reset)
    for seed in (0, 1):
        demos = demos_of(trained)
        data = SkillData(demos[0].clean, demos[0].corrected)
        skill = SkillLearner(trained.loop, 0, data, ("reference",), TINY.skill, TINY.dex, seed)
        chaining = Chaining(trained.task, TINY.chain, seed)
        chain = ChainLearner(trained.loop, [], chaining, ("reference",), TINY.amounts, seed)
        for draws in (
            partial(record_demos, trained.loop, TINY.demos, ("reference",), seed),
            skill._explore,
            skill._test,
            chain._explore,
            chain._test,
            partial(evaluate, trained.loop, policy, "reference", 4, seed),
            partial(calibrate, trained.loop, policy, 4, seed),
        ):
            with pytest.raises(SeenError) as caught:
                draws()
            layouts.append(np.array(caught.value.args[0]).tobytes())
    assert len(set(layouts)) == len(layouts) == 14


def test_an_unknown_method_is_refused_with_those_there_are(trained: Run) -> None:
    with pytest.raises(TrainingError, match=r"choose one of dex, gcbc, planned, .*viskill_sr"):
        methods.learn("magic", trained)


def test_a_finished_run_becomes_a_bundle_that_loads(trained: Run, tmp_path: Path) -> None:
    opened = Run.open(trained.folder, quiet)
    what = load_trained(opened, "viskill")
    folder = export(what, tmp_path / "b", episodes=4, say=quiet, threshold=0.25)
    bundle = load_bundle(folder)
    assert bundle.manifest.value is not None
    assert bundle.manifest.value.threshold == 0.25
    assert "--threshold 0.25" in (folder / "MODEL_CARD.md").read_text()
    assert bundle.manifest.subgoals == "chaining"
    assert set(bundle.chaining) == {"grasp", "handover"}
    assert set(bundle.values) == {"grasp", "handover", "release"}
    assert [m.distribution for m in bundle.manifest.measured] == ["reference", "wide"]
    assert "viskill train bipegtransfer --method viskill" in (folder / "MODEL_CARD.md").read_text()


def test_a_value_that_is_no_probability_is_not_exported_as_one(
    trained: Run, tmp_path: Path
) -> None:
    """The runtime turns back where the probability of success is low."""
    run = without_chain(trained, tmp_path / "run")
    methods.learn("viskill_dm", run)
    folder = export(load_trained(run, "viskill_dm"), tmp_path / "b", episodes=0, say=quiet)
    with pytest.raises(TrainingError, match="no value for a threshold"):
        export(load_trained(run, "viskill_dm"), tmp_path / "c", 0, say=quiet, threshold=0.7)
    bundle = load_bundle(folder)
    assert bundle.manifest.value is None
    assert not bundle.values
    card = (folder / "MODEL_CARD.md").read_text()
    assert "how near its end comes to a demonstrated start" in card
    assert "It has no value that tells how likely" in card


def test_a_card_says_with_which_settings_it_was_trained(trained: Run, tmp_path: Path) -> None:
    card = (
        export(load_trained(trained, "viskill"), tmp_path / "b", episodes=0, say=quiet)
        / "MODEL_CARD.md"
    ).read_text()
    assert "--settings settings.json" in card
    assert '"environments": 4' in card
    assert "It was trained with exact poses" in card


def test_a_bundle_takes_the_place_of_an_older_one_of_its_name_alone(
    trained: Run, tmp_path: Path
) -> None:
    what, folder = load_trained(trained, "viskill"), tmp_path / "b"
    export(what, folder, episodes=0, say=quiet)
    (folder / "skill-grasp.onnx").unlink()
    export(what, folder, episodes=0, say=quiet)
    assert load_bundle(folder).manifest.name == "bipegtransfer-viskill"
    assert [path.name for path in tmp_path.iterdir()] == ["b"]
    (folder / "notes.txt").touch()
    with pytest.raises(TrainingError, match=r"holds notes\.txt besides"):
        export(what, folder, episodes=0, say=quiet)
    (folder / "notes.txt").unlink()
    link = tmp_path / "link"
    link.symlink_to(folder)
    export(what, link, episodes=0, say=quiet)
    assert link.is_symlink() and load_bundle(folder).manifest.name == "bipegtransfer-viskill"
    link.unlink()
    with pytest.raises(TrainingError, match="where the command runs"):
        export(what, Path(), episodes=0, say=quiet)
    with pytest.raises(TrainingError, match="holds the bundle bipegtransfer-viskill"):
        check_place(folder, "bipegtransfer-self_imitation")
    file = tmp_path / "file"
    file.touch()
    for place in (file, trained.folder):
        with pytest.raises(TrainingError, match="no bundle"):
            export(what, place, episodes=0, say=quiet)


def test_export_is_a_command_that_tells_how_far_it_is(trained: Run, tmp_path: Path) -> None:
    arguments = ["export", str(trained.folder), str(tmp_path / "b"), "--episodes", "4"]
    ran = CliRunner().invoke(app, arguments)
    assert ran.exit_code == 0, ran.output
    assert "reference: " in ran.stdout and "of 4 episodes" in ran.stdout
    assert load_bundle(tmp_path / "b").manifest.measured


def test_demonstrations_and_episodes_are_counted(trained: Run, tmp_path: Path) -> None:
    run = run_in(tmp_path)
    told: list[dict[str, object]] = []
    run.watch = told.append
    demos_of(run)
    counted = [line for line in told if line["stage"] == "demos" and "round" in line]
    assert counted[-1] == {"stage": "demos", "round": 7, "rounds": 8}
    done: list[tuple[int, int]] = []
    policy = methods.learn("viskill", trained)
    evaluate(trained.loop, policy, "wide", 5, 0, lambda *both: done.append(both))
    assert done == [(4, 5), (5, 5)]


def test_an_older_bundle_stays_where_the_new_one_cannot_take_its_place(
    trained: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    what, folder = load_trained(trained, "viskill"), tmp_path / "b"
    export(what, folder, episodes=0, say=quiet)
    whole = Path.replace

    def refuses(path: Path, target: Path) -> Path:
        if path.name == "new":
            raise OSError(28, "No space left on device")
        return whole(path, target)

    monkeypatch.setattr(Path, "replace", refuses)
    with pytest.raises(OSError, match="No space"):
        export(what, folder, episodes=0, say=quiet)
    assert load_bundle(folder).manifest.name == "bipegtransfer-viskill"


@pytest.mark.parametrize(
    ("method", "words"),
    [("dex", "no chaining policy"), ("tstar", "no chaining policy"), ("magic", "choose one of")],
)
def test_what_cannot_be_exported_is_refused(trained: Run, method: str, words: str) -> None:
    with pytest.raises(TrainingError, match=words):
        load_trained(trained, method)


def test_an_unfinished_run_is_not_exported(trained: Run, tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="has not finished skill-grasp"):
        load_trained(run_in(tmp_path), "viskill")
