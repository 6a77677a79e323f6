"""A bundle whose skills are driven by its task's scripted controller instead of trained graphs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from viskill_deploy.bundle.format import Bundle, load_bundle
from viskill_deploy.sim.tasks.base import Task


@dataclass(frozen=True)
class ScriptedSession:
    """Answers as ONNX Runtime does, with the script's actions."""

    task: Task
    skill: str

    def run(self, names: Sequence[str], feed: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        obs, goal = (feed[key].astype(np.float64) for key in ("obs", "goal"))
        assert list(names) == ["action"]
        rows = [self.task.scripted_action(self.skill, *row) for row in zip(obs, goal, strict=True)]
        return [np.array(rows, dtype=np.float32)]


def scripted(folder: Path, task: Task) -> Bundle:
    """The bundle in `folder`, which fits the task, with the script in the place of its graphs."""
    bundle = load_bundle(folder)
    sessions = {skill.name: ScriptedSession(task, skill.name) for skill in task.skills}
    return Bundle(bundle.path, bundle.manifest, sessions)  # type: ignore[arg-type]
