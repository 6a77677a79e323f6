"""Official checkpoints become bundles that compute what the official networks compute."""

import math
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import official_files as files
import onnxruntime
import pytest
from chaining import resign
from typer.testing import CliRunner

from viskill_deploy.bundle.chain import SkillChain
from viskill_deploy.bundle.format import Bundle, load_bundle
from viskill_deploy.bundle.official.checkpoint import Official, read_official
from viskill_deploy.bundle.official.convert import write_bundle
from viskill_deploy.bundle.official.layout import find_checkpoints
from viskill_deploy.bundle.subgoals import subgoal_source
from viskill_deploy.cli import inspect
from viskill_deploy.cli.main import app
from viskill_deploy.core.errors import BundleError, MotionError
from viskill_deploy.motion.waypoints import start_waypoint
from viskill_deploy.runtime.preflight import prepare
from viskill_deploy.sim.closed_loop import ClosedLoop
from viskill_deploy.sim.tasks.base import load_task

TASK = load_task("bipegtransfer")
VECTORS = dict(np.load(files.GOLDEN / "vectors.npz"))
HALF_ULP_M = 2.4e-7 / 2
"""Rounding of a scaled position between 2 and 4 to float32, which the graphs take."""

SMALLEST_STD = 0.01
SCALE, ORIGIN = 5.0, np.array([0.55, 0.0, 0.6971])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("official")


@pytest.fixture(scope="module")
def weights(folder: Path) -> dict[str, np.ndarray]:
    return files.whole(folder / "exp")


@pytest.fixture(scope="module")
def policy(folder: Path, weights: dict[str, np.ndarray]) -> Official:
    return read_official(find_checkpoints(folder / "exp"), TASK)


@pytest.fixture(scope="module")
def bundle(folder: Path, policy: Official) -> Bundle:
    return load_bundle(write_bundle(policy, TASK, folder / "bundle"))


def outputs(bundle: Bundle, file: str, **inputs: np.ndarray) -> dict[str, np.ndarray]:
    session = onnxruntime.InferenceSession((bundle.path / file).read_bytes())
    names = [node.name for node in session.get_outputs()]
    feed = {name: values.astype(np.float32) for name, values in inputs.items()}
    return dict(zip(names, session.run(names, feed), strict=True))


def normalized(policy: Official, skill: str, rows: np.ndarray) -> np.ndarray:
    networks = policy.skills[skill]
    parts = ((VECTORS["obs"], networks.observation), (VECTORS["goal"], networks.goal))
    return np.concatenate(
        [np.clip((x[rows] - n.mean) / n.std, -n.clip, n.clip) for x, n in parts], axis=1
    )


@pytest.mark.parametrize("skill", files.SKILLS)
def test_the_normalizers_scale_inputs_as_the_official_code_does(
    policy: Official, bundle: Bundle, skill: str
) -> None:
    rows = VECTORS["skill"] == skill
    wished = VECTORS["network_input"][rows]
    assert np.abs(normalized(policy, skill, rows) - wished).max() < 1e-6
    obs, goal = VECTORS["obs"][rows], VECTORS["goal"][rows]
    seen = outputs(bundle, f"skill-{skill}.onnx", obs=obs, goal=goal)["network_input"]
    assert np.abs(seen - wished).max() < HALF_ULP_M / SMALLEST_STD + 1e-6
    assert (np.abs(wished) == 5.0).any(), "the vectors exercise the clip"


@pytest.mark.parametrize("skill", files.SKILLS)
def test_a_skill_graph_computes_action_and_value_of_the_networks(
    policy: Official, bundle: Bundle, weights: dict[str, np.ndarray], skill: str
) -> None:
    rows = VECTORS["skill"] == skill
    told = outputs(
        bundle, f"skill-{skill}.onnx", obs=VECTORS["obs"][rows], goal=VECTORS["goal"][rows]
    )
    assert next(iter(told)) == "action"
    x = normalized(policy, skill, rows)
    action = np.tanh(files.network(x, weights, f"{skill}.actor.trunk.mlp"))
    value = files.network(np.hstack([x, action]), weights, f"{skill}.critic.q.mlp")
    assert np.abs(told["action"] - action).max() < 1e-5
    assert np.abs(told["q"] - value).max() < 1e-5
    assert np.ptp(action, axis=0).min() > 0.01


@pytest.mark.parametrize("skill", files.SKILLS[:-1])
def test_chain_and_value_graphs_compute_subgoal_spread_and_the_smaller_value(
    bundle: Bundle, weights: dict[str, np.ndarray], skill: str
) -> None:
    obs, unused = VECTORS["obs"], np.zeros((300, 3))
    chosen = outputs(bundle, f"chain-{skill}.onnx", obs=obs, task_goal=unused)
    answer = files.network(obs, weights, f"actor.actors.{skill}.trunk.mlp")
    assert np.abs(chosen["subgoal"] - 4.0 * np.tanh(answer[:, :6])).max() < 1e-5
    log_std = -5.0 + 3.5 * (np.tanh(answer[:, 6:]) + 1.0)
    assert np.abs(chosen["log_std"] - log_std).max() < 1e-5
    subgoal = VECTORS["test_subgoal"]
    told = outputs(
        bundle,
        f"value-{skill}.onnx",
        obs=obs,
        task_goal=unused,
        subgoal=np.pad(subgoal, ((0, 0), (0, 2)), constant_values=1.0),
    )
    seen = np.hstack([obs, subgoal / 4.0])
    q1, q2 = (files.network(seen, weights, f"critic.qs.{skill}.{q}.mlp") for q in ("q1", "q2"))
    for name, wished in (("q1", q1), ("q2", q2), ("value", np.minimum(q1, q2))):
        assert np.abs(told[name] - wished).max() < 1e-5, name
    assert (q1 < q2).any() and (q2 < q1).any()


def official(x: np.ndarray) -> np.ndarray:
    """An observation of ours in the official world, written out by hand."""
    y = x.copy()
    for start in (0, 7, 14, 23, 29):
        y[start : start + 3] = SCALE * (x[start : start + 3] + ORIGIN)
    y[17:23] = SCALE * x[17:23]
    return y


def test_a_start_observation_is_that_of_the_official_simulator(bundle: Bundle) -> None:
    scene = TASK.sample_layout(np.random.default_rng(0), "reference")
    seen = TASK.observe(start_waypoint(TASK.cell).T_task_tip, (0.0, 0.0), scene)
    ours = bundle.skills["grasp"].inward["obs"](seen)
    assert ours == pytest.approx(official(seen), abs=1e-12)
    arms = ours[:14]
    for theirs in VECTORS["first_obs"]:
        assert arms == pytest.approx(theirs[:14], abs=2e-3), "arms: position x 5, angles, jaws"
        assert ours[16] == pytest.approx(theirs[16], abs=0.01), "the block's height"
        assert ours[17:20] == pytest.approx(ours[14:17] - ours[0:3], abs=1e-9)


def test_the_adapter_gives_graphs_scaled_positions_and_the_runtime_metres(bundle: Bundle) -> None:
    rng = np.random.default_rng(3)
    ours, goal, task_goal = rng.normal(0, 0.03, 35), rng.normal(0, 0.03, 8), rng.normal(0, 0.03, 3)
    theirs = goal.copy()
    theirs[:3], theirs[3:6] = (SCALE * (goal[k : k + 3] + ORIGIN) for k in (0, 3))
    feed = {"obs": official(ours)[None], "goal": theirs[None]}
    wished = outputs(bundle, "skill-grasp.onnx", **feed)["action"][0]
    assert bundle.skills["grasp"](ours, goal) == pytest.approx(wished, abs=1e-6)
    feed = {"obs": official(ours)[None], "task_goal": np.zeros((1, 3))}
    chosen = outputs(bundle, "chain-handover.onnx", **feed)["subgoal"][0]
    metres = chosen / SCALE - np.tile(ORIGIN, 2)
    assert bundle.chaining["handover"](ours, task_goal) == pytest.approx(metres, abs=1e-7)
    value = outputs(bundle, "value-grasp.onnx", **feed, subgoal=theirs[None])["value"][0]
    assert bundle.values["grasp"](ours, task_goal, goal) == pytest.approx(value, abs=1e-6)


def test_the_manifest_says_scale_frame_control_point_and_measured_reference(
    bundle: Bundle,
) -> None:
    manifest = bundle.manifest
    assert manifest.adapter is not None
    assert manifest.adapter.length_scale == 5.0
    assert manifest.adapter.task_origin_m == (0.55, 0.0, 0.6971)
    assert manifest.adapter.control_point == "jaw_pivot"
    assert manifest.action.reference == "measured"
    assert [(s.name, s.budget) for s in manifest.skills] == [
        ("grasp", 45),
        ("handover", 35),
        ("release", 20),
    ]
    low, high = manifest.training_range.lower, manifest.training_range.upper
    assert low[0] < -0.05 < high[0], "PSM1's x at the start, m, task frame"


def reachable(key: str, shape: tuple[int, ...]) -> np.ndarray:
    """Weights of a policy that keeps still and chooses subgoals over the board."""
    values = np.zeros(shape, dtype=np.float32)
    if key.startswith("actor.actors") and key.endswith("6.bias") and "release" not in key:
        metres = np.array([0.01, 0.02, 0.05, 0.0, -0.02, 0.04]) + np.tile(ORIGIN, 2)
        values[:6] = np.arctanh(SCALE * metres / 4.0)
    if key.startswith("critic.qs") and key.endswith("6.bias"):
        values[:] = -0.3 if "q1" in key else 0.7
    return values


@pytest.fixture(scope="module")
def still(folder: Path) -> Bundle:
    files.whole(folder / "still", reachable)
    policy = read_official(find_checkpoints(folder / "still"), TASK)
    return load_bundle(write_bundle(policy, TASK, folder / "still-bundle"))


def test_a_chain_runs_with_subgoals_in_metres_and_tells_its_action_value(still: Bundle) -> None:
    scene = TASK.sample_layout(np.random.default_rng(0), "reference")
    seen = TASK.observe(start_waypoint(TASK.cell).T_task_tip, (0.0, 0.0), scene)
    chain = SkillChain(still, subgoal_source(still, TASK, np.random.default_rng(0)))
    starts = {}
    while not chain.finished:
        choice = chain.act(seen, scene)
        starts[choice.skill] = choice.start
    grasp = starts["grasp"]
    assert grasp.subgoal == pytest.approx([0.01, 0.02, 0.05, 0.0, -0.02, 0.04, 0, 1], abs=1e-6)
    assert grasp.source == "chaining"
    assert grasp.value == pytest.approx(-0.3, abs=1e-6), "no probability, told as it is"
    assert starts["release"].source == "task"
    assert starts["release"].value is None


def test_skills_alone_become_a_bundle_with_scripted_subgoals(
    folder: Path, policy: Official, tmp_path: Path
) -> None:
    alone = Official(policy.skills, {})
    with pytest.raises(BundleError, match="--subgoals scripted"):
        write_bundle(alone, TASK, tmp_path / "refused")
    loaded = load_bundle(write_bundle(alone, TASK, tmp_path / "alone", scripted=True))
    assert loaded.manifest.subgoals == "scripted"
    assert loaded.chaining == loaded.values == {}


def test_with_scripted_subgoals_chaining_checkpoints_are_not_opened(tmp_path: Path) -> None:
    files.whole(tmp_path / "exp")
    for seed in (1, 2):  # two to choose from, and none that could be read
        path = files.chaining_path(tmp_path / "exp", seed=seed)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"broken")
    command = ["import", "official", str(tmp_path / "exp"), "-o", str(tmp_path / "mine")]
    ran = CliRunner().invoke(app, [*command, "--subgoals", "scripted"])
    assert ran.exit_code == 0, ran.exception
    assert "viskill/" not in ran.stdout
    assert not load_bundle(tmp_path / "mine").chaining
    assert "--chaining-seed" in str(CliRunner().invoke(app, command).exception)
    contrary = [*command, "--subgoals", "scripted", "--chaining-seed", "1"]
    assert CliRunner().invoke(app, contrary).exit_code == 2


def test_a_folder_in_use_is_not_overwritten(policy: Official, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(BundleError, match="not an empty folder"):
        write_bundle(policy, TASK, tmp_path)
    assert (tmp_path / "mine.txt").read_text() == "keep"


@pytest.mark.parametrize("name", ["mine [v2]", ".hidden"])
def test_a_folder_whose_name_is_none_for_a_bundle_is_refused(
    policy: Official, tmp_path: Path, name: str
) -> None:
    with pytest.raises(BundleError, match="no name for a bundle"):
        write_bundle(policy, TASK, tmp_path / name)
    assert not (tmp_path / name).exists()


def test_import_load_and_a_first_action_need_no_torch(folder: Path, tmp_path: Path) -> None:
    source, target = str(folder / "still"), str(tmp_path / "b")
    code = f"""
import sys
sys.modules["torch"] = None
sys.argv = ["viskill", "import", "official", {source!r}, "-o", {target!r}]
from viskill_deploy.cli.main import app
app(standalone_mode=False)
import numpy as np
from viskill_deploy.bundle.format import load_bundle
print(load_bundle({target!r}).skills["grasp"](np.zeros(35), np.zeros(8)).tolist())
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stdout.endswith(f"{[0.0] * 10}\n")


def test_a_probability_needs_a_threshold_and_a_return_has_none(
    still: Bundle, tmp_path: Path
) -> None:
    copy = Path(shutil.copytree(still.path, tmp_path / "copy"))
    table = still.manifest.model_dump(mode="json")["value"]
    resign(copy, value=table | {"threshold": 0.5})
    with pytest.raises(BundleError, match="a return has none"):
        load_bundle(copy)
    resign(copy, value=table | {"meaning": "probability"})
    with pytest.raises(BundleError, match=r"value\.graphs"):
        load_bundle(copy)


def test_a_return_that_is_no_number_is_refused(still: Bundle) -> None:
    chain = SkillChain(still, subgoal_source(still, TASK, np.random.default_rng(0)))
    scene = TASK.sample_layout(np.random.default_rng(0), "reference")
    seen = TASK.observe(start_waypoint(TASK.cell).T_task_tip, (0.0, 0.0), scene)
    seen[20] = np.nan
    with pytest.raises(MotionError):
        chain.act(seen, scene)


def test_inspect_tells_of_the_adapter_and_of_the_value(still: Bundle, capsys: Any) -> None:
    inspect.command(still.path, json_=False)
    told = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "lengths x 5, task frame at (0.55, 0, 0.6971) m of the world" in told
    assert "no probability" in told
    assert "it fits the cell bipegtransfer" in told


def test_a_run_tells_that_its_values_are_returns(still: Bundle) -> None:
    told = prepare(still.path).about()
    assert (told["value_meaning"], told["value_threshold"]) == ("return", None)


def test_inspect_shows_texts_of_a_bundle_as_they_are(
    still: Bundle, tmp_path: Path, capsys: Any
) -> None:
    copy = Path(shutil.copytree(still.path, tmp_path / "copy"))
    figure = {"distribution": "mine [/v2]", "mode": "plan", "episodes": 1, "success_rate": 0.0}
    resign(copy, method="[red]own", created_by="me [/v2]", measured=[figure | {"command": ""}])
    inspect.command(copy, json_=False)
    told = capsys.readouterr().out
    assert "[red]own" in told
    assert "me [/v2]" in told
    assert "mine [/v2]" in told


def test_a_plan_takes_actions_as_the_manifest_means_them(still: Bundle) -> None:
    """A still policy opens its jaws to the official 40 degrees, not to the task's own angle."""
    loop = ClosedLoop(TASK, action=still.manifest.action.spec())
    loop.reset(TASK.sample_layout(np.random.default_rng(0), "reference"))
    loop.step(np.zeros(10), TASK.skills[0])
    assert loop.waypoint.jaw == pytest.approx([math.radians(40.0)] * 2)
    assert math.radians(40.0) != TASK.action.jaw_open_rad
