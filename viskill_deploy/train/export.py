"""From a training run to a policy bundle: ONNX graphs, manifest, model card."""

from __future__ import annotations

import os
import shlex
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from viskill_deploy.bundle.format import (
    MANIFEST,
    ActionEntry,
    ArmEntry,
    ChainingEntry,
    LayoutEntry,
    Manifest,
    Measured,
    SkillEntry,
    TrainingRange,
    ValueEntry,
    chain_file,
    read_manifest,
    skill_file,
    value_file,
    write_manifest,
)
from viskill_deploy.core.errors import BundleError, TrainingError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.sim.tasks.base import Layout
from viskill_deploy.train import methods, store
from viskill_deploy.train.card import model_card
from viskill_deploy.train.chain_learning import Chained
from viskill_deploy.train.chaining import Chaining
from viskill_deploy.train.evaluate import Score, evaluate
from viskill_deploy.train.graph import chain_graph, skill_graph, value_graph
from viskill_deploy.train.network import scaling_of, size
from viskill_deploy.train.replay import Float32Array
from viskill_deploy.train.run import Run, actor, demos_of
from viskill_deploy.train.subgoal_space import POSITIONS, chain_layout, value_layout

CARD = "MODEL_CARD.md"
TOLERANCE = 1e-5
CHECKED_STATES = 512
VALUE_THRESHOLD = 0.5
"""Below this success is unlikely, and the runtime does not go on."""


@dataclass(frozen=True)
class Trained:
    """What a finished run has learned.

    Attributes:
        run: where it lies.
        method: of the chaining policy.
        skills: result of every skill, as `run.skills_of` gives it.
        chaining: policies and values.
    """

    run: Run
    method: str
    skills: Sequence[dict[str, Any]]
    chaining: Chaining


def load_trained(run: Run, method: str) -> Trained:
    """The results of a run.

    Raises:
        TrainingError: the run is not finished, or the method has nothing to export.
    """
    if not methods.chains(method):
        raise TrainingError(f"{method} has no chaining policy to export; choose a chaining method")
    stages = [f"skill-{skill.name}" for skill in run.task.skills] + [f"chain-{method}"]
    for stage in stages:
        if not run.done(stage):
            raise TrainingError(
                f"{run.folder} has not finished {stage}; train it with --method {method} first"
            )
    chaining = Chaining(run.task, run.settings.chain, run.seed)
    chaining.load(store.load(run.result(stages[-1])))
    skills = [store.load(run.result(stage)) for stage in stages[:-1]]
    return Trained(run, method, skills, chaining)


def export(
    trained: Trained,
    output: Path,
    episodes: int = 100,
    seed: int = 0,
    say: Callable[[str], None] = print,
    threshold: float = VALUE_THRESHOLD,
) -> Path:
    """Writes the bundle of a finished run and measures it.

    Args:
        trained: what the run has learned.
        output: the bundle's folder, made if missing; an older bundle of the same name in it is
            replaced when the new one is whole.
        episodes: evaluated in each of the task's distributions; 0 for none.
        seed: of the evaluation episodes.
        say: told about progress.
        threshold: of the value, for the bundle.

    Returns:
        The bundle's folder.

    Raises:
        TrainingError: a graph does not compute what its network computes, the folder holds
            something else than such a bundle, or there is no value for a threshold of one's own.
    """
    run = trained.run
    if threshold != VALUE_THRESHOLD and not methods.value_is_probability(trained.method):
        raise TrainingError(f"{trained.method} has no value for a threshold; leave it out")
    place = output.resolve()
    check_place(place, name_of(trained))
    graphs = graphs_of(trained)
    policy = Chained([actor(run, skill["weights"]) for skill in trained.skills], trained.chaining)
    scores = []
    for distribution in run.task.distributions if episodes else ():
        count = run.counting(distribution)
        scores.append(evaluate(run.trial, policy, distribution, episodes, seed, count))
        say(f"{distribution}: {scores[-1].success_rate:.1%} of {episodes} episodes")
    words = ["viskill", "export", os.path.relpath(run.folder), os.path.relpath(output)]
    words += ["--method", trained.method, "--episodes", str(episodes), "--seed", str(seed)]
    words += [] if threshold == VALUE_THRESHOLD else ["--threshold", f"{threshold:g}"]
    command = shlex.join(words)
    manifest = build_manifest(trained, scores, command, threshold)
    card = model_card(manifest, run.settings, scores, command, os.path.relpath(run.folder))
    place.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f"{place.name}-", dir=place.parent) as beside:
        new = Path(beside) / "new"
        new.mkdir()
        for name, graph in graphs.items():
            (new / name).write_bytes(graph)
        (new / CARD).write_text(card, "utf-8")
        write_manifest(new, manifest)
        old = place.replace(Path(beside) / "old") if place.exists() else None
        try:
            new.replace(place)
        except OSError:
            if old:
                old.replace(place)
            raise
    say(f"bundle written to {output}")
    return output


def name_of(trained: Trained) -> str:
    """The bundle's name."""
    return f"{trained.run.task.name}-{trained.method}"


def check_place(output: Path, name: str) -> None:
    """Refuses a place that a bundle may not take.

    Raises:
        TrainingError: it holds anything but an older bundle of the same name, or is where the
            command runs.
    """
    if output == Path.cwd():
        raise TrainingError(f"{output} is where the command runs; name a folder for the bundle")
    if not output.exists() or (output.is_dir() and not any(output.iterdir())):
        return
    try:
        there = read_manifest(output)
    except BundleError as error:
        raise TrainingError(
            f"{output} holds something that is no bundle ({error.reason}); name a new folder"
        ) from error
    surplus = {path.name for path in output.iterdir()} - {MANIFEST, *there.files}
    if there.name != name:
        raise TrainingError(f"{output} holds the bundle {there.name}; name a new folder")
    if surplus:
        raise TrainingError(
            f"{output} holds {', '.join(sorted(surplus))} besides its bundle; move it elsewhere"
        )


def graphs_of(trained: Trained) -> dict[str, bytes]:
    """Every graph of the bundle by its file's name, each checked against its network."""
    task, chaining = trained.run.task, trained.chaining
    n, m = size(task.observation_layout), size(task.goal_layout)
    skill_scale = scaling_of(task)
    chain_scale, value_scale = (scaling_of(task, f(task)) for f in (chain_layout, value_layout))
    demos = demos_of(trained.run)
    graphs: dict[str, bytes] = {}
    for index, skill in enumerate(task.skills):
        data = demos[index].clean
        obs, goal = data.obs[:, 0][:CHECKED_STATES], data.goal[:CHECKED_STATES]
        goals3 = np.tile(np.array([0.01, 0.02, 0.005], np.float32), (len(obs), 1))
        feed = {"obs": obs, "goal": goal, "task_goal": goals3, "subgoal": goal}
        weights = trained.skills[index]["weights"]
        act = actor(trained.run, weights)
        name = skill_file(skill.name)
        graphs[name] = _checked(name, skill_graph(skill_scale, weights, n, m), feed, act(obs, goal))
        if methods.value_is_probability(trained.method):
            name = value_file(skill.name)
            wished = chaining.probability(index, obs, goals3, goal[:, :POSITIONS])[:, None]
            graph = value_graph(value_scale, chaining.values[index][0].weights(), n, m)
            graphs[name] = _checked(name, graph, feed, wished)
        if index < len(task.skills) - 1:
            name = chain_file(skill.name)
            policy = chaining.policies[index].network.weights()
            graph = chain_graph(chain_scale, policy, chaining.space, n)
            graphs[name] = _checked(name, graph, feed, chaining.choose(index, obs, goals3))
    return graphs


def _checked(name: str, graph: bytes, feed: dict[str, Float32Array], wished: FloatArray) -> bytes:
    """The graph, if it computes what is wished.

    Raises:
        TrainingError: it does not.
    """
    session = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
    mine = {node.name: feed[node.name] for node in session.get_inputs()}
    worst = float(np.abs(session.run(None, mine)[0] - wished).max())
    if not worst <= TOLERANCE:
        raise TrainingError(f"{name} differs from its network by {worst:.2g}; report this")
    return graph


def build_manifest(
    trained: Trained, scores: Sequence[Score], command: str, threshold: float
) -> Manifest:
    """The manifest of a bundle, hashes still empty."""
    task = trained.run.task
    names = [skill.name for skill in task.skills]
    value = ValueEntry(graphs={name: value_file(name) for name in names}, threshold=threshold)
    return Manifest(
        schema=1,
        name=name_of(trained),
        task=task.name,
        cell=task.cell.name,
        method=trained.method,
        created_by=f"viskill-deploy {version('viskill-deploy')}",
        arms=tuple(
            ArmEntry(name=arm.name, robot=arm.entry.robot, tool=arm.entry.tool)
            for arm in task.cell.arms
        ),
        frame="task",
        control_point="jaw_pivot",
        length_unit="m",
        step_s=task.cell.file.motion.step_s,
        action=ActionEntry.of(task.action),
        observation=_layout(task.observation_layout),
        goal=_layout(task.goal_layout),
        skills=tuple(
            SkillEntry(
                name=skill.name,
                file=skill_file(skill.name),
                budget=skill.budget,
                may_open_jaw=skill.may_open_jaw,
            )
            for skill in task.skills
        ),
        subgoals="chaining",
        chaining=ChainingEntry(graphs={name: chain_file(name) for name in names[:-1]}),
        value=value if methods.value_is_probability(trained.method) else None,
        training_range=training_range(trained.skills),
        seeds=(trained.run.seed,),
        measured=tuple(
            Measured(
                distribution=score.distribution,
                mode="learning-world",
                episodes=score.episodes,
                success_rate=score.success_rate,
                command=command,
            )
            for score in scores
        ),
        files={},
    )


def training_range(skills: Sequence[dict[str, Any]]) -> TrainingRange:
    """Smallest and largest value of every observation entry that any skill has seen."""
    low = np.min([skill["seen"][0] for skill in skills], axis=0)
    high = np.max([skill["seen"][1] for skill in skills], axis=0)
    return TrainingRange(lower=tuple(map(float, low)), upper=tuple(map(float, high)))


def _layout(layout: Layout) -> tuple[LayoutEntry, ...]:
    return tuple(LayoutEntry(name=name, size=length) for name, length in layout)
