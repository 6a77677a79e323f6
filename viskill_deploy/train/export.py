"""From a training run to a policy bundle: ONNX graphs, manifest, model card."""

from __future__ import annotations

import os
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np
import onnxruntime
import torch

from viskill_deploy.bundle.format import (
    ActionEntry,
    ArmEntry,
    LayoutEntry,
    Manifest,
    Measured,
    SkillEntry,
    TrainingRange,
    write_manifest,
)
from viskill_deploy.core.errors import TrainingError
from viskill_deploy.sim.tasks.base import Layout, Task, load_task
from viskill_deploy.train.card import model_card
from viskill_deploy.train.checkpoint import Checkpoint, load_checkpoint
from viskill_deploy.train.episodes import workers
from viskill_deploy.train.evaluate import Score, evaluate
from viskill_deploy.train.fit import Labelled
from viskill_deploy.train.imitation import Say, graphs_of
from viskill_deploy.train.network import SkillNetwork, scaling_of

METHOD = "imitation"
CARD = "MODEL_CARD.md"
TOLERANCE = 1e-6
CHECKED_STATES = 512


def export(
    run: Path,
    output: Path,
    episodes: int = 100,
    seed: int = 0,
    processes: int = 2,
    say: Say = print,
) -> Path:
    """Writes the bundle of a finished training run and measures it.

    Args:
        run: folder that `imitation.train` wrote.
        output: the bundle's folder; made if missing, its own files are replaced.
        episodes: evaluated in each of the task's distributions; 0 for none.
        seed: of the evaluation episodes.
        processes: to share them among.
        say: told about progress.

    Returns:
        The bundle's folder.

    Raises:
        TrainingError: there is no run, or a graph does not compute what the network computes.
        BundleError: the folder holds files that do not belong to a bundle.
    """
    state = load_checkpoint(run)
    if state is None or not state.weights:
        raise TrainingError(f"{run} holds no training run; train first")
    task = load_task(state.task)
    graphs = graphs_of(task, state.weights)
    for name, graph in graphs.items():
        check_graph(task, state, name, graph)
    with workers(processes if episodes else 1) as pool:
        scores = []
        for distribution in task.distributions if episodes else ():
            scores.append(evaluate(task, graphs, distribution, episodes, seed, pool))
            say(f"{distribution}: {scores[-1].success_rate:.0%} of {episodes} episodes")
    output.mkdir(parents=True, exist_ok=True)
    for name, graph in graphs.items():
        (output / graph_file(name)).write_bytes(graph)
    command = f"viskill export {os.path.relpath(run)} {os.path.relpath(output)}"
    command += f" --episodes {episodes} --seed {seed}"
    manifest = build_manifest(task, state, scores, command)
    (output / CARD).write_text(model_card(manifest, state, scores, command), encoding="utf-8")
    write_manifest(output, manifest)
    say(f"bundle written to {output}")
    return output


def graph_file(skill: str) -> str:
    """Name of a skill's graph in a bundle."""
    return f"skill-{skill}.onnx"


def check_graph(task: Task, state: Checkpoint, skill: str, graph: bytes) -> float:
    """Largest difference between graph and network on states of the training run.

    Raises:
        TrainingError: it is above 1e-6.
    """
    data = state.data[skill]
    rows = np.linspace(0, len(data.obs) - 1, CHECKED_STATES).astype(int)
    feed = {"obs": data.obs[rows], "goal": data.goal[rows]}
    network = SkillNetwork(scaling_of(task), data.action.shape[1])
    network.load(state.weights[skill])
    with torch.no_grad():
        expected = network(*(torch.from_numpy(value) for value in feed.values())).numpy()
    session = onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])
    worst = float(np.abs(session.run(["action"], feed)[0] - expected).max())
    if not worst <= TOLERANCE:
        raise TrainingError(
            f"the graph of {skill} differs from its network by {worst:.2g}; report this"
        )
    return worst


def build_manifest(
    task: Task, state: Checkpoint, scores: Sequence[Score], command: str
) -> Manifest:
    """The manifest of a bundle, hashes still empty."""
    spec = task.action
    return Manifest(
        schema=1,
        name=f"{task.name}-{METHOD}",
        task=task.name,
        cell=task.cell.name,
        method=METHOD,
        created_by=f"viskill-deploy {version('viskill-deploy')}",
        arms=tuple(
            ArmEntry(name=arm.name, robot=arm.entry.robot, tool=arm.entry.tool)
            for arm in task.cell.arms
        ),
        frame="task",
        control_point="jaw_pivot",
        length_unit="m",
        step_s=task.cell.file.motion.step_s,
        action=ActionEntry(
            reference=spec.reference,
            displacement_m=spec.displacement_m,
            max_displacement_m=spec.max_displacement_m,
            rotation=spec.rotation,
            rotation_rad=spec.rotation_rad,
            pitch_rad=spec.pitch_rad,
            jaw="binary",
            jaw_open_rad=spec.jaw_open_rad,
        ),
        observation=_layout(task.observation_layout),
        goal=_layout(task.goal_layout),
        skills=tuple(
            SkillEntry(
                name=skill.name,
                file=graph_file(skill.name),
                budget=skill.budget,
                may_open_jaw=skill.may_open_jaw,
            )
            for skill in task.skills
        ),
        subgoals="scripted",
        training_range=training_range(list(state.data.values())),
        seeds=(state.seed,),
        measured=tuple(
            Measured(
                distribution=score.distribution,
                mode="closed-loop",
                episodes=score.episodes,
                success_rate=score.success_rate,
                command=command,
            )
            for score in scores
        ),
        files={},
    )


def training_range(data: Sequence[Labelled]) -> TrainingRange:
    """Smallest and largest value of every observation entry in the training states."""
    low = np.min([part.obs.min(axis=0) for part in data], axis=0)
    high = np.max([part.obs.max(axis=0) for part in data], axis=0)
    return TrainingRange(lower=tuple(map(float, low)), upper=tuple(map(float, high)))


def _layout(layout: Layout) -> tuple[LayoutEntry, ...]:
    return tuple(LayoutEntry(name=name, size=size) for name, size in layout)
