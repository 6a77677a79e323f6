"""What is looked at before a cell may be armed, first part: every file. Nothing moves here.

`runtime.rehearsing` looks at the rest: the scene, the start and the whole plan.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from viskill_deploy.bundle.format import MANIFEST, Bundle, load_bundle
from viskill_deploy.core import data
from viskill_deploy.core.calibration_files import (
    CalibrationFile,
    calibrated,
    is_simulated,
    read_calibration,
)
from viskill_deploy.core.description import CellDescription, load_cell
from viskill_deploy.core.errors import BundleError, CalibrationError, DataFileError
from viskill_deploy.core.scene_files import SeenScene, read_scene
from viskill_deploy.runtime.checklist import Checklist, Found, Line
from viskill_deploy.safety.calibration import calibration_margin, judge_calibration
from viskill_deploy.safety.envelope import CellEnvelope
from viskill_deploy.sim.scene import build_model
from viskill_deploy.sim.tasks.base import Task, load_task
from viskill_deploy.sim.things import Things

DAY_S = 86400.0

PERIOD_S = 0.004
"""Control period that is assumed where a run has not yet said its own."""


@dataclass(frozen=True)
class Sources:
    """The files that a run is made of.

    Attributes:
        bundle: folder of the policy bundle, or the name of one in a `policies` folder.
        robot: name of a cell in `robots/cells`, or path of a cell file; "" for the bundle's own.
        calibration: calibration file of the cell; a cell of real arms needs one.
        scene: scene file; None where the simulator or a tracker says where things are.
        date_s: Unix time of asking, by which calibrations age; without one, all are too old.
    """

    bundle: Path
    robot: str = ""
    calibration: Path | None = None
    scene: Path | None = None
    date_s: float = math.nan


@dataclass(frozen=True)
class Prepared:
    """A bundle, its task and its cell, held against each other.

    Attributes:
        files: path and SHA-256 of every data file that the run uses.
        notes: what people should know, such as a file that stands in front of a packaged one.
        lines: what was looked at so far.
        scene: the scene that was given; None where the simulator or a tracker tells.
    """

    bundle: Bundle
    task: Task
    cell: CellDescription
    files: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]
    lines: tuple[Line, ...] = ()
    scene: SeenScene | None = None

    @property
    def name(self) -> str:
        """The bundle's name."""
        return self.bundle.manifest.name

    @property
    def distributions(self) -> Sequence[str]:
        """Where layouts can be drawn from."""
        return self.task.distributions

    def about(self) -> dict[str, Any]:
        """What a run's figures say of it."""
        manifest = self.bundle.manifest
        return {
            "task": manifest.task,
            "bundle": manifest.name,
            "subgoals": manifest.subgoals,
            "subgoal_layout": [{"name": part.name, "size": part.size} for part in manifest.goal],
            "value_threshold": manifest.value.threshold if manifest.value else None,
            "value_meaning": manifest.value.meaning if manifest.value else None,
        }


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


def find_calibration(path: Path) -> Path:
    """The calibration file as named, or the one of that name that came with the package."""
    places = [path] if path.is_absolute() else [path, *(root / path for root in data.data_roots())]
    return next((place for place in places if place.exists()), path)


def prepare(sources: Sources | Path) -> Prepared:
    """Loads the files of a run and checks that they fit; a path alone is that of a bundle.

    Raises:
        BundleError: the bundle is wrong or was trained for something else.
        CalibrationError: the calibration is wrong, too old, or another cell's; or there is none.
        DataFileError: a robot, tool, cell or scene file is wrong.
    """
    checklist = Checklist()
    given = sources if isinstance(sources, Sources) else Sources(sources)
    prepared = look_at_files(checklist, given)
    checklist.insist()
    assert prepared is not None  # nothing has failed
    return prepared


def look_at_files(checklist: Checklist, sources: Sources) -> Prepared | None:
    """Adds a line for every kind of file.

    Returns:
        None when nothing can be made of the bundle and its cell. After a failure of what is asked
        later (`checklist.error`), something to go on looking with.
    """
    bundle = checklist.look("bundle", "S28", partial(_bundle, sources.bundle))
    if bundle is None:
        return None
    pair = checklist.look("robot", "", partial(_robot, bundle, sources.robot))
    if pair is None:
        return None
    nominal, task = pair
    look = partial(calibrated_cell, nominal, sources.calibration, sources.date_s)
    cell = checklist.look("calibration", "S27", look) or nominal
    if cell is not nominal:
        task = load_task(task.name, cell)
    checklist.look("limits", "", partial(_limits, cell))
    seen = None
    if sources.scene is not None:
        seen = checklist.look("scene file", "", partial(_scene, cell, sources.scene))
    used = [*cell.files, bundle.path / MANIFEST]
    used += [bundle.path / name for name in bundle.manifest.files]
    used += [] if seen is None else [seen.path]
    files, lines = data.digests(used), tuple(checklist.lines)
    return Prepared(bundle, task, cell, files, _notes(cell), lines, seen)


def _notes(cell: CellDescription) -> tuple[str, ...]:
    return tuple(
        f"{file} stands in front of the packaged {hidden}"
        for file in cell.files
        if (hidden := data.shadows(file)) is not None
    )


def _bundle(path: Path) -> Found[Bundle]:
    bundle = load_bundle(find_bundle(path))
    files = len(bundle.manifest.files) + 1
    return Found(bundle, f"{files} files of {bundle.path} are as exported")


def _robot(bundle: Bundle, robot: str) -> Found[tuple[CellDescription, Task]]:
    manifest = bundle.manifest
    cell = load_cell(robot or manifest.cell)
    check_fits(bundle, cell)
    task = load_task(manifest.task, cell)
    _check_layout(bundle, task)
    arms = ", ".join(f"{arm.name} ({arm.entry.robot}, {arm.entry.tool})" for arm in cell.arms)
    shadowing = _notes(cell)
    return Found((cell, task), "; ".join([arms, *shadowing]), warns=bool(shadowing))


def calibrated_cell(cell: CellDescription, path: Path | None, now: float) -> Found[CellDescription]:
    """The cell as a calibration has it, which has to be young and fine enough.

    Args:
        cell: as its file has it.
        path: of the calibration; None where there is none.
        now: Unix time, by which it ages.

    Raises:
        CalibrationError: it is wrong, too old, too coarse or another cell's; or it is missing.
    """
    if path is None:
        if is_simulated(cell):
            return Found(cell, "none, and simulated arms need none")
        raise CalibrationError(
            f"{cell.files[0]}: its arms are real; name their calibration file with --calibration"
        )
    path = find_calibration(path)
    calibration = read_calibration(path)
    placed = calibrated(cell, calibration, path)
    for verdict in judge_calibration(calibration, now):
        raise CalibrationError(f"{path}: {_too(calibration, verdict.arm, now)}")
    age = (now - calibration.created.timestamp()) / DAY_S
    worst = max(arm.residual_rms_m for arm in calibration.arms)
    old = "of simulated arms" if calibration.simulated else f"{age:.1f} days old"
    text = f"{old}, residual {1e3 * worst:.2f} mm, by {calibration.method}"
    return Found(placed, text, calibration_margin(calibration, now))


def _too(calibration: CalibrationFile, arm: int, now: float) -> str:
    if arm < 0:
        age = (now - calibration.created.timestamp()) / DAY_S
        when = f"is dated {-age:.1f} days ahead" if age < 0.0 else f"is {age:.1f} days old"
        return f"{when}; calibrate the cell again, or set this machine's clock"
    entry = calibration.arms[arm]
    return (
        f"the residual of {entry.name} is {1e3 * entry.residual_rms_m:.2f} mm; measure more "
        "points and calibrate the cell again"
    )


def _limits(cell: CellDescription) -> Found[CellEnvelope]:
    envelope = CellEnvelope.of(cell, PERIOD_S)
    return Found(envelope, "none is looser than the gate's ceilings")


def _scene(cell: CellDescription, path: Path) -> Found[SeenScene]:
    seen = read_scene(path, cell.name)
    known = Things(build_model(cell)).names
    for thing in seen.scene.objects:
        if thing.name not in known:
            reason = f"no object {thing.name!r} in {cell.name}; it has {', '.join(known) or 'none'}"
            raise DataFileError(seen.path, "object", f"{reason}; correct its name")
    sigma = max(float(C.diagonal()[:3].max()) ** 0.5 for C in seen.covariance.values())
    many = len(seen.scene.objects)
    return Found(
        seen,
        f"{many} object{'s' * (many > 1)}, {seen.scene.active} to be moved; positions known "
        f"within {1e3 * sigma:.2f} mm (one sigma)",
    )


def check_fits(bundle: Bundle, cell: CellDescription) -> None:
    """Refuses a bundle that was trained for other arms, tools or another cell.

    Raises:
        BundleError: names what differs.
    """
    manifest = bundle.manifest
    if manifest.cell != cell.name:
        raise BundleError(
            bundle.path, f"was trained for cell {manifest.cell!r}, not {cell.name!r}; use that cell"
        )
    wanted = [(arm.name, arm.robot, arm.tool) for arm in manifest.arms]
    present = [(arm.name, arm.entry.robot, arm.entry.tool) for arm in cell.arms]
    for want, have in zip(wanted, present, strict=False):
        if want != have:
            raise BundleError(
                bundle.path,
                f"was trained with {' '.join(want)}, the cell holds {' '.join(have)}; "
                "mount that tool or train a bundle for this cell",
            )
    if len(wanted) != len(present):
        raise BundleError(bundle.path, f"needs {len(wanted)} arms, the cell has {len(present)}")


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
