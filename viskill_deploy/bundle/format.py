"""The policy bundle, version 1: a folder with `manifest.json`, ONNX graphs and a model card.

Every file's SHA-256 stands in the manifest, and the manifest carries its own digest, so a changed
byte anywhere is found. Graphs are loaded from the very bytes that were hashed. No pickle is read.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import onnxruntime
from onnxruntime.capi import onnxruntime_pybind11_state as ort_errors
from pydantic import Field, ValidationError

from viskill_deploy.core.cell_files import Rotation
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import BundleError
from viskill_deploy.core.robot_files import Positive, Table
from viskill_deploy.motion.waypoints import PITCH_UNIT_RAD, ActionSpec

MANIFEST = "manifest.json"
MAX_FILE_BYTES = 64 * 2**20

ORT_ERRORS: tuple[type[Exception], ...] = (
    ort_errors.Fail,
    ort_errors.InvalidArgument,
    ort_errors.InvalidGraph,
    ort_errors.InvalidProtobuf,
    ort_errors.NoSuchFile,
    ort_errors.NotImplemented,
    ort_errors.RuntimeException,
    RuntimeError,
    ValueError,
)
"""ONNX Runtime's errors share no base class."""


class ArmEntry(Table):
    """An arm that the policy was trained with."""

    name: str
    robot: str
    tool: str


class ActionEntry(Table):
    """What the numbers of an action mean; five an arm. A single `rotation` is that of every arm."""

    reference: Literal["setpoint", "measured"]
    displacement_m: Positive
    max_displacement_m: Positive
    rotation: Rotation | tuple[Rotation, ...]
    rotation_rad: Positive
    pitch_rad: Positive = PITCH_UNIT_RAD
    jaw: Literal["binary"]
    jaw_open_rad: Positive

    def spec(self) -> ActionSpec:
        """The same for `motion.waypoints.apply_action`."""
        return ActionSpec(
            self.reference,
            self.displacement_m,
            self.max_displacement_m,
            self.rotation_rad,
            self.jaw_open_rad,
            self.rotation,
            self.pitch_rad,
        )


class LayoutEntry(Table):
    """A named stretch of a vector."""

    name: str
    size: int = Field(gt=0)


class SkillEntry(Table):
    """One skill: its graph, its budget in policy steps, and which jaws it may open."""

    name: str
    file: str
    budget: int = Field(gt=0)
    may_open_jaw: tuple[bool, ...]


class TrainingRange(Table):
    """Smallest and largest value of every observation entry seen in training."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]


class Measured(Table):
    """A success figure with the command that gave it."""

    distribution: str
    mode: str
    episodes: int = Field(gt=0)
    success_rate: float = Field(ge=0, le=1)
    command: str


class Manifest(Table):
    """`manifest.json`. Frames: task frame; control point: the jaw pivot; lengths in metres."""

    schema_version: Literal[1] = Field(alias="schema")
    name: str
    task: str
    cell: str
    method: str
    created_by: str
    arms: tuple[ArmEntry, ...]
    frame: Literal["task"]
    control_point: Literal["jaw_pivot"]
    length_unit: Literal["m"]
    step_s: Positive
    action: ActionEntry
    observation: tuple[LayoutEntry, ...]
    goal: tuple[LayoutEntry, ...]
    skills: tuple[SkillEntry, ...] = Field(min_length=1)
    subgoals: Literal["scripted"]
    chaining: None = None
    value: None = None
    training_range: TrainingRange
    seeds: tuple[int, ...]
    measured: tuple[Measured, ...]
    files: dict[str, str]
    digest: str = ""

    @property
    def observation_size(self) -> int:
        """Length of the observation."""
        return sum(entry.size for entry in self.observation)

    @property
    def goal_size(self) -> int:
        """Length of a subgoal."""
        return sum(entry.size for entry in self.goal)


@dataclass(frozen=True)
class Bundle:
    """A bundle that passed every check.

    Attributes:
        path: its folder.
        manifest: what it says.
        sessions: ONNX Runtime session of every skill, by skill name; one thread each.
    """

    path: Path
    manifest: Manifest
    sessions: dict[str, onnxruntime.InferenceSession]


def digest(content: dict[str, Any]) -> str:
    """Hex SHA-256 of a manifest's content without its `digest` entry."""
    body = {key: value for key, value in content.items() if key != "digest"}
    text = json.dumps(body, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def write_manifest(folder: Path, manifest: Manifest) -> Path:
    """Writes `manifest.json` with the hashes of the files that lie in `folder`.

    Any `files` and `digest` in `manifest` are replaced. Returns the manifest's path.
    """
    hashes = {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.iterdir())
        if path.is_file() and path.name != MANIFEST
    }
    content = manifest.model_dump(mode="json", by_alias=True) | {"files": hashes}
    content["digest"] = digest(content)
    target = folder / MANIFEST
    target.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    return target


def load_bundle(path: Path | str) -> Bundle:
    """A checked bundle.

    Raises:
        BundleError: a changed byte, a path that leaves the folder, an unknown file, a wrong schema
            or shape; names the file and what to do.
    """
    folder = Path(path)
    manifest = read_manifest(folder)
    contents = _checked_files(folder, manifest)
    sessions = {
        skill.name: _session(folder / skill.file, contents, skill.file, manifest)
        for skill in manifest.skills
    }
    return Bundle(folder, manifest, sessions)


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a bundle, its digest checked; raises BundleError."""
    path = folder / MANIFEST
    if not path.is_file():
        raise BundleError(folder, f"holds no {MANIFEST}; name the folder of a policy bundle")
    if path.stat().st_size > MAX_FILE_BYTES:
        raise BundleError(path, "is far too large for a manifest; fetch the bundle again")
    try:
        content = json.loads(path.read_text(encoding="utf-8"), parse_constant=_no_constant)
        manifest = Manifest.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise BundleError(path, f"{key}: {first['msg']}; export the bundle again") from error
    except (OSError, ValueError, RecursionError) as error:
        raise BundleError(path, f"is not readable ({error}); fetch the bundle again") from error
    if manifest.digest != digest(content):
        raise BundleError(path, "was changed after export; fetch or export the bundle again")
    _check_sizes(path, manifest)
    return manifest


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


def _no_constant(text: str) -> float:
    raise ValueError(f"{text} is no number for a manifest")


def _check_sizes(path: Path, manifest: Manifest) -> None:
    rng = manifest.training_range
    sizes = {len(rng.lower), len(rng.upper), manifest.observation_size}
    if len(sizes) != 1 or any(a > b for a, b in zip(rng.lower, rng.upper, strict=True)):
        raise BundleError(path, "training_range does not fit the observation; export it again")
    arms = len(manifest.arms)
    if not isinstance(rotation := manifest.action.rotation, str) and len(rotation) != arms:
        raise BundleError(path, "action.rotation needs one entry, or one an arm; export it again")
    for skill in manifest.skills:
        if len(skill.may_open_jaw) != arms:
            raise BundleError(path, f"skill {skill.name}: may_open_jaw needs one entry an arm")
    if len({skill.name for skill in manifest.skills}) != len(manifest.skills):
        raise BundleError(path, "two skills share a name; rename one and export again")


def _checked_files(folder: Path, manifest: Manifest) -> dict[str, bytes]:
    contents = {}
    for name, expected in manifest.files.items():
        path = folder / name
        if Path(name).name != name or name in {"", ".", ".."} or path.is_symlink():
            raise BundleError(path, "leaves the bundle's folder; refuse this bundle")
        if not path.is_file():
            raise BundleError(path, "is listed in the manifest but missing; fetch it again")
        if path.stat().st_size > MAX_FILE_BYTES:
            raise BundleError(path, "is larger than a bundle's file may be; export it again")
        contents[name] = path.read_bytes()
        if hashlib.sha256(contents[name]).hexdigest() != expected:
            raise BundleError(path, "was changed after export (SHA-256); fetch the bundle again")
    unlisted = {entry.name for entry in folder.iterdir()} - set(contents) - {MANIFEST}
    if unlisted:
        raise BundleError(folder, f"holds unlisted {sorted(unlisted)}; remove them")
    return contents


def _session(
    path: Path, contents: dict[str, bytes], name: str, manifest: Manifest
) -> onnxruntime.InferenceSession:
    if name not in contents:
        raise BundleError(path, "is named by a skill but not listed in files; export again")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(
            contents[name], options, providers=["CPUExecutionProvider"]
        )
    except ORT_ERRORS as error:
        raise BundleError(path, f"is no usable ONNX graph ({error}); export it again") from error
    wanted_inputs = {"obs": manifest.observation_size, "goal": manifest.goal_size}
    wanted_outputs = {"action": 5 * len(manifest.arms)}
    for wanted, nodes in (
        (wanted_inputs, session.get_inputs()),
        (wanted_outputs, session.get_outputs()),
    ):
        found = {node.name: (node.type, len(node.shape), *node.shape[-1:]) for node in nodes}
        expected = {key: ("tensor(float)", 2, size) for key, size in wanted.items()}
        if found != expected:
            raise BundleError(
                path, f"has {found}, the manifest says {expected}; export the bundle again"
            )
    return session
