"""A tiny training from demonstrations to a bundle: whole, resumed, and repeated."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from viskill_deploy.bundle.format import load_bundle
from viskill_deploy.core.errors import TrainingError
from viskill_deploy.train import methods, store
from viskill_deploy.train.chain_learning import ChainAmounts, ChainLearner
from viskill_deploy.train.chaining import Chaining, ChainSettings
from viskill_deploy.train.demos import DemoSettings
from viskill_deploy.train.dex import DexSettings
from viskill_deploy.train.evaluate import evaluate
from viskill_deploy.train.export import export, load_trained
from viskill_deploy.train.run import Run, actor, demos_of, skill_learner, skills_of
from viskill_deploy.train.settings import RunSettings
from viskill_deploy.train.skill_learning import SkillSettings

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


def test_a_folder_with_other_settings_is_refused(trained: Run) -> None:
    settings = dataclasses.replace(TINY, environments=5)
    with pytest.raises(TrainingError, match="name an empty folder"):
        Run(trained.folder, "bipegtransfer", 0, settings, quiet)


@pytest.mark.parametrize("method", ["viskill_sr", "viskill_dm", "viskill_ldm", "self_imitation"])
def test_every_ablation_learns_over_the_same_skills(trained: Run, method: str) -> None:
    policy = methods.learn(method, Run.open(trained.folder, quiet))
    assert (trained.folder / f"chain-{method}.npz").is_file()
    score = evaluate(trained.loop, policy, "reference", 4, 0)
    assert score.episodes == 4


@pytest.mark.parametrize("method", ["gcbc", "dex", "tstar"])
def test_every_baseline_learns(trained: Run, method: str) -> None:
    policy = methods.learn(method, Run.open(trained.folder, quiet))
    score = evaluate(trained.loop, policy, "wide", 4, 0)
    assert 0.0 <= score.success_rate <= 1.0


def test_an_unknown_method_is_refused_with_those_there_are(trained: Run) -> None:
    with pytest.raises(TrainingError, match=r"choose one of dex, gcbc, .*viskill_sr"):
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


def test_an_unfinished_run_is_not_exported(trained: Run, tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="has not finished skill-grasp"):
        load_trained(run_in(tmp_path), "viskill")
