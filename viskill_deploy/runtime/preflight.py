"""What is looked at before a cell may be armed: bundle, cell, files. Nothing moves here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from viskill_deploy.bundle.format import MANIFEST, Bundle, check_fits, load_bundle
from viskill_deploy.core import data
from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.errors import BundleError
from viskill_deploy.sim.tasks.base import Task, load_task


@dataclass(frozen=True)
class Prepared:
    """A bundle, its task and its cell, held against each other.

    Attributes:
        files: path and SHA-256 of every data file that the run uses.
        notes: what people should know, such as a file that stands in front of a packaged one.
    """

    bundle: Bundle
    task: Task
    cell: CellDescription
    files: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]


def find_bundle(path: Path) -> Path:
    """The bundle's folder: as given, or, for a bare name, in a `policies` folder of the data.

    Raises:
        BundleError: neither is there.
    """
    if path.is_dir():
        return path
    for root in data.data_roots() if path.name == str(path) else ():
        candidate = root / "policies" / path.name
        if candidate.is_dir():
            return candidate
    raise BundleError(path, "is no folder; name a policy bundle, see `viskill doctor`")


def prepare(path: Path) -> Prepared:
    """Loads a bundle with its task and cell, and checks that they fit.

    Raises:
        BundleError: the bundle is wrong or was trained for something else.
        DataFileError: a robot, tool or cell file is wrong.
    """
    bundle = load_bundle(find_bundle(path))
    manifest = bundle.manifest
    cell = load_cell(manifest.cell)
    task = load_task(manifest.task, cell)
    check_fits(bundle, cell)
    _check_layout(bundle, task)
    used = [*cell.files, bundle.path / MANIFEST]
    used += [bundle.path / name for name in manifest.files]
    notes = [
        f"{file} stands in front of the packaged {hidden}"
        for file in cell.files
        if (hidden := data.shadows(file)) is not None
    ]
    files = tuple((str(file), data.sha256(file)) for file in used)
    return Prepared(bundle, task, cell, files, tuple(notes))


def _check_layout(bundle: Bundle, task: Task) -> None:
    manifest = bundle.manifest
    for what, theirs, ours in (
        ("observation", manifest.observation, task.observation_layout),
        ("goal", manifest.goal, task.goal_layout),
    ):
        if tuple((entry.name, entry.size) for entry in theirs) != ours:
            raise BundleError(
                bundle.path,
                f"its {what} is not laid out as task {task.name!r} gives it; export it again",
            )
    theirs_skills = [(s.name, s.budget, s.may_open_jaw) for s in manifest.skills]
    if theirs_skills != [(s.name, s.budget, s.may_open_jaw) for s in task.skills]:
        raise BundleError(bundle.path, f"its skills are not those of {task.name!r}; export again")
    is_own = manifest.adapter is not None or manifest.action.spec() == task.action
    if not is_own or manifest.step_s != task.cell.file.motion.step_s:
        raise BundleError(
            bundle.path,
            f"its actions or its step are not those of {task.name!r} here; train it again",
        )
