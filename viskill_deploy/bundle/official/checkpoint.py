"""One official policy, read and held against its task: networks and normalizers as arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from viskill_deploy.bundle.format import CHOSEN_SIZE
from viskill_deploy.bundle.official.layout import Found
from viskill_deploy.bundle.official.torch_file import Array, Float32Array, Record, read_torch_file
from viskill_deploy.core.errors import BundleError
from viskill_deploy.sim.tasks.base import Task

Layers = tuple[tuple[Float32Array, Float32Array], ...]
"""Weights (out, in) and biases (out,) of a network, first layer first; ReLU between them."""

State = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Normalizer:
    """Scales a vector: clip((x - mean) / std, -clip, clip), all in scaled units."""

    mean: Float32Array
    std: Float32Array
    clip: float


@dataclass(frozen=True, slots=True)
class SkillNetworks:
    """One skill.

    Attributes:
        path: its checkpoint.
        actor: [observation, goal], both normalized, to the action before its tanh.
        critic: [observation, goal, action] to its action value.
    """

    path: Path
    actor: Layers
    critic: Layers
    observation: Normalizer
    goal: Normalizer


@dataclass(frozen=True, slots=True)
class ChainNetworks:
    """The chaining policy for one skill.

    Attributes:
        actor: observation to six means before their tanh and six raw log-stds.
        critics: the two of the double Q: [observation, subgoal / range] to a value.
    """

    actor: Layers
    critics: tuple[Layers, Layers]


@dataclass(frozen=True, slots=True)
class Official:
    """A whole policy.

    Attributes:
        skills: by name, in the task's order.
        chaining: by the name of the skill that it chooses for; empty without one.
    """

    skills: Mapping[str, SkillNetworks]
    chaining: Mapping[str, ChainNetworks]


def read_official(found: Found, task: Task) -> Official:
    """The policy in the checkpoints that were found.

    Raises:
        BundleError: a file is broken, of another task, or the files do not belong together.
    """
    names = [skill.name for skill in task.skills]
    missing = [name for name in names if name not in found.skills]
    if missing:
        there = ", ".join(found.skills)
        raise BundleError(
            next(iter(found.skills.values())).parents[2],
            f"lacks a checkpoint for {', '.join(missing)} of {task.name} (it holds {there}); "
            "train it, or put its folder here",
        )
    skills = {name: _skill(found.skills[name], task) for name in names}
    if found.chaining is None:
        return Official(skills, {})
    state = _state(found.chaining)
    for name in names:
        _check_same(found.chaining, state, name, skills[name])
    size = _size(task.observation_layout)
    chaining = {name: _chain(found.chaining, state, name, size) for name in names[:-1]}
    return Official(skills, chaining)


def _size(layout: tuple[tuple[str, int], ...]) -> int:
    return sum(count for _, count in layout)


def _state(path: Path) -> State:
    content = read_torch_file(path)
    state = content.get("state_dict")
    if not isinstance(state, dict):
        raise BundleError(path, "holds no state_dict; name a checkpoint of the official code")
    return state


def _skill(path: Path, task: Task) -> SkillNetworks:
    content = read_torch_file(path)
    state = content.get("state_dict")
    if not isinstance(state, dict) or not {"o_norm", "g_norm"} <= content.keys():
        raise BundleError(
            path, "is no skill-learning checkpoint (it lacks state_dict, o_norm or g_norm)"
        )
    obs, goal = _size(task.observation_layout), _size(task.goal_layout)
    action = 5 * len(task.cell.arms)
    return SkillNetworks(
        path,
        _layers(path, state, "actor.trunk.mlp", obs + goal, action),
        _layers(path, state, "critic.q.mlp", obs + goal + action, 1),
        _normalizer(path, "o_norm", content["o_norm"], obs),
        _normalizer(path, "g_norm", content["g_norm"], goal),
    )


def _chain(path: Path, state: State, skill: str, size: int) -> ChainNetworks:
    at = f"sc_agent.critic.qs.{skill}"
    first, second = (
        _layers(path, state, f"{at}.{q}.mlp", size + CHOSEN_SIZE, 1) for q in ("q1", "q2")
    )
    actor = _layers(path, state, f"sc_agent.actor.actors.{skill}.trunk.mlp", size, 2 * CHOSEN_SIZE)
    return ChainNetworks(actor, (first, second))


def _layers(path: Path, state: State, prefix: str, inputs: int, outputs: int) -> Layers:
    """A network of linear layers, every second entry of a torch Sequential."""
    layers: list[tuple[Float32Array, Float32Array]] = []
    count = 0
    while f"{prefix}.{2 * count}.weight" in state:
        weight = _numbers(state[f"{prefix}.{2 * count}.weight"])
        bias = _numbers(state.get(f"{prefix}.{2 * count}.bias"))
        if weight.ndim != 2 or weight.shape[:1] != bias.shape:
            raise BundleError(path, f"{prefix}.{2 * count} is no linear layer of finite numbers")
        layers.append((weight, bias))
        count += 1
    known = sum(key.startswith(f"{prefix}.") for key in state)
    if not layers or known != 2 * count:
        raise BundleError(path, f"has no {prefix} of linear layers as the official code builds it")
    if any(len(a[1]) != b[0].shape[1] for a, b in pairwise(layers)):
        raise BundleError(path, f"{prefix}: its layers do not fit each other")
    found = (layers[0][0].shape[1], len(layers[-1][1]))
    if found != (inputs, outputs):
        raise BundleError(
            path,
            f"{prefix} takes {found[0]} numbers and gives {found[1]}, this task needs {inputs} and "
            f"{outputs}; is it a checkpoint of another task or another kind?",
        )
    return tuple(layers)


def _numbers(values: Any) -> Float32Array:
    """A tensor of finite numbers; an empty one in place of anything else."""
    if isinstance(values, np.ndarray) and np.isfinite(values).all():
        return values
    return np.empty(0, dtype=np.float32)


def _normalizer(path: Path, name: str, record: Any, size: int) -> Normalizer:
    fields = record.fields if isinstance(record, Record) else {}
    mean, std = (_vector(fields.get(key)) for key in ("mean", "std"))
    clip = fields.get("default_clip_range")
    if mean.shape != (size,) or std.shape != (size,) or not isinstance(clip, int | float):
        raise BundleError(
            path, f"{name} is no normalizer of {size} numbers; is it of another task or kind?"
        )
    if not (np.isfinite(mean).all() and (std > 0).all() and np.isfinite(std).all() and clip > 0):
        raise BundleError(path, f"{name} holds numbers that scale nothing; train the skill again")
    return Normalizer(mean, std, float(clip))


def _vector(values: Any) -> Float32Array:
    array = values.values if isinstance(values, Array) else np.empty(0)
    return np.asarray(array, dtype=np.float32)


def _check_same(path: Path, state: State, name: str, skill: SkillNetworks) -> None:
    """The chaining checkpoint has to hold the very skill that is used."""
    prefix = f"sl_agent.{name}.actor.trunk.mlp"
    if not any(key.startswith(f"{prefix}.") for key in state):
        raise BundleError(
            path, f"is no chaining checkpoint of this task: it knows no skill {name!r}"
        )
    inputs, outputs = skill.actor[0][0].shape[1], len(skill.actor[-1][1])
    theirs = _layers(path, state, prefix, inputs, outputs)
    same = len(theirs) == len(skill.actor) and all(
        np.array_equal(a, b)
        for one, two in zip(theirs, skill.actor, strict=True)
        for a, b in zip(one, two, strict=True)
    )
    if not same:
        raise BundleError(
            path,
            f"was trained over another {name!r} than {skill.path}; choose the skills' seed with "
            "--skill-seed, put away episodes later than those that it was trained over, or leave "
            "it out with --subgoals scripted",
        )
