"""Finding the checkpoints in a folder of the official ViSkill code.

skill_learning/<task>-v0/SL_DEX/d<n>/s<seed>/<skill>/model/weights_ep<N>.pth
viskill/<task>-v0/SC_SAC_SIL_SL_DEX/d<n>/rs<n>/s<seed>/model/weights_ep<N>.pth

Only the ends of the paths count, so a part of such a tree will do. The largest N is the latest.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from viskill_deploy.core.errors import BundleError

TASKS: Mapping[str, str] = {
    "BiPegTransfer": "bipegtransfer",
    "BiPegBoard": "bipegboard",
    "MatchBoard": "matchboardpanel",
}
"""Names of the official tasks, and of ours."""

_WEIGHTS = re.compile(r"weights_ep(\d+)\.pth")
_TASK = re.compile(r"(\w+)-v\d+")
_SEED = re.compile(r"s(\d+)")


@dataclass(frozen=True, slots=True)
class Found:
    """Which files make up one policy.

    Attributes:
        task: our name of the task.
        skills: the latest checkpoint of every skill, by its name.
        chaining: the latest chaining checkpoint; None where there is none, or none is wanted.
    """

    task: str
    skills: Mapping[str, Path]
    chaining: Path | None


def find_checkpoints(
    folder: Path,
    task: str | None = None,
    skill_seed: int | None = None,
    chaining_seed: int | None = None,
    scripted: bool = False,
) -> Found:
    """The latest checkpoints of one task and one seed below a folder.

    Args:
        folder: where to look.
        task: official or our name of the task, for a folder with several.
        skill_seed: seed of the skills, for a folder with several.
        chaining_seed: seed of the chaining policy, likewise.
        scripted: the skills alone are wanted; chaining checkpoints do not count.

    Raises:
        BundleError: nothing there, or more than one choice; names the choices.
    """
    if not folder.is_dir():
        raise BundleError(folder, "is no folder; name the one that the official code wrote")
    models = _models(folder)
    if not models:
        raise BundleError(
            folder,
            "holds no <task>-v0/…/model/weights_ep<N>.pth; name the folder above skill_learning/ "
            "and viskill/",
        )
    tasks = {_task_of(model) for model in models}
    wanted = TASKS.get(task or "", task)
    if wanted is not None and wanted not in tasks:
        raise BundleError(folder, f"holds {', '.join(sorted(tasks))}, no {wanted}")
    if wanted is None and len(tasks) > 1:
        raise BundleError(folder, f"holds {', '.join(sorted(tasks))}; choose one with --task")
    name = wanted or tasks.pop()
    mine = {model: latest for model, latest in models.items() if _task_of(model) == name}
    chaining = {m.parent: p for m, p in mine.items() if _SEED.fullmatch(m.parent.name)}
    skills: dict[Path, dict[str, Path]] = {}
    for model, latest in mine.items():
        if model.parent not in chaining:
            skills.setdefault(model.parent.parent, {})[model.parent.name] = latest
    if not skills:
        raise BundleError(
            folder,
            "holds a chaining checkpoint without its skills; the normalizers of their inputs are "
            "in the skill_learning checkpoints alone: put those beside it",
        )
    chosen = _one(folder, skills, skill_seed, "--skill-seed")
    if scripted or not chaining:
        return Found(name, skills[chosen], None)
    last = _one(folder, chaining, chaining_seed, "--chaining-seed")
    return Found(name, skills[chosen], chaining[last])


def _models(folder: Path) -> dict[Path, Path]:
    """The latest checkpoint in every `model` folder."""
    numbered: dict[Path, tuple[int, Path]] = {}
    for path in folder.resolve().rglob("weights_ep*.pth"):
        match = _WEIGHTS.fullmatch(path.name)
        if match and path.parent.name == "model" and path.is_file():
            entry = (int(match[1]), path)
            numbered[path.parent] = max(entry, numbered.get(path.parent, entry))
    return {model: path for model, (_, path) in sorted(numbered.items())}


def _task_of(model: Path) -> str:
    """Our name of the task that a path belongs to."""
    for part in reversed(model.parts):
        if (match := _TASK.fullmatch(part)) and match[1] in TASKS:
            return TASKS[match[1]]
    raise BundleError(
        model, f"has none of the folders {', '.join(f'{t}-v0' for t in TASKS)} above it"
    )


def _one(folder: Path, seeds: Mapping[Path, object], seed: int | None, option: str) -> Path:
    """The only folder of a seed, or the one of the wanted seed."""
    fitting = [path for path in seeds if seed is None or path.name == f"s{seed}"]
    if len(fitting) == 1:
        return fitting[0]
    choices = ", ".join(str(path.relative_to(folder.resolve())) for path in seeds)
    hint = f"choose a seed with {option}, or name a deeper folder"
    raise BundleError(folder, f"holds {choices or 'no seed'}; {hint}")
