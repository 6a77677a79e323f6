"""The state of a training run on disk: plain arrays and JSON, no pickle."""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from viskill_deploy.core.errors import TrainingError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.train.fit import Labelled

CHECKPOINT = "checkpoint.npz"
LOG = "train.jsonl"


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A training run between two rounds.

    Attributes:
        task: the task's name.
        seed: of the run.
        settings: amounts, as plain values.
        rounds_done: rounds that are in it.
        weights: by skill, then by layer.
        data: labelled states by skill.
    """

    task: str
    seed: int
    settings: dict[str, Any]
    rounds_done: int
    weights: dict[str, dict[str, FloatArray]]
    data: dict[str, Labelled]


def save_checkpoint(folder: Path, state: Checkpoint) -> None:
    """Writes the run into `folder`; a crash leaves the old file whole."""
    arrays: dict[str, Any] = {}
    for skill, layers in state.weights.items():
        arrays.update({f"weights/{skill}/{key}": value for key, value in layers.items()})
    for skill, data in state.data.items():
        for key in ("obs", "goal", "action"):
            arrays[f"data/{skill}/{key}"] = getattr(data, key)
    facts = {
        "task": state.task,
        "seed": state.seed,
        "settings": state.settings,
        "rounds_done": state.rounds_done,
    }
    new = folder / f"new-{CHECKPOINT}"
    np.savez_compressed(new, facts=np.array(json.dumps(facts)), **arrays)
    new.replace(folder / CHECKPOINT)


def load_checkpoint(folder: Path) -> Checkpoint | None:
    """The run in `folder`, or None where there is none.

    Raises:
        TrainingError: the file is damaged.
    """
    path = folder / CHECKPOINT
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files}
        facts = json.loads(str(arrays.pop("facts")))
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise TrainingError(f"{path} is damaged ({error}); train into an empty folder") from error
    weights: dict[str, dict[str, FloatArray]] = {}
    data: dict[str, dict[str, Any]] = {}
    for key, value in arrays.items():
        kind, skill, name = key.split("/")
        target = weights if kind == "weights" else data
        target.setdefault(skill, {})[name] = value
    return Checkpoint(
        facts["task"],
        facts["seed"],
        facts["settings"],
        facts["rounds_done"],
        weights,
        {skill: Labelled(**parts) for skill, parts in data.items()},
    )
