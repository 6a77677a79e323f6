"""The policy bundle, version 1: a folder with `manifest.json`, ONNX graphs and a model card.

`docs/bundle.md` says what the graphs take and give. Every file's SHA-256 stands in the manifest,
and the manifest carries its own digest, so a changed byte anywhere is found. Graphs are loaded from
the very bytes that were hashed. No pickle is read.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError

from viskill_deploy.bundle.adapter import AdapterEntry, adapters
from viskill_deploy.bundle.graphs import Affine, Graph, Signature, open_graph
from viskill_deploy.core.cell_files import Rotation
from viskill_deploy.core.errors import BundleError
from viskill_deploy.core.robot_files import Positive, Table
from viskill_deploy.core.sealed import read_sealed, sealed
from viskill_deploy.core.types import ObservationRange
from viskill_deploy.motion.waypoints import PITCH_UNIT_RAD, ActionSpec

MANIFEST = "manifest.json"
KINDS = frozenset({".onnx", ".md", ".txt"})
"""What a bundle may hold beside its manifest: graphs, and text for people."""

MAX_MANIFEST_BYTES = 2**20
MAX_FILE_BYTES = 64 * 2**20
MAX_BUNDLE_BYTES = 256 * 2**20
"""A shipped bundle has 1 MB."""

NAME = r"^\w[\w.+ -]*$"
"""What a bundle may be called: folders and tables of people carry its name."""

TASK_GOAL_SIZE = 3
"""Length of the task's goal as graphs see it: the point in `Scene.goal`, m."""

CHOSEN_SIZE = 6
"""Numbers that a chaining policy chooses: the two positions that lead every subgoal, m."""


def skill_file(skill: str) -> str:
    """Name of a skill's graph in a bundle."""
    return f"skill-{skill}.onnx"


def chain_file(skill: str) -> str:
    """Name of the graph that chooses a skill's subgoal."""
    return f"chain-{skill}.onnx"


def value_file(skill: str) -> str:
    """Name of the graph that tells how likely success is at a skill's start."""
    return f"value-{skill}.onnx"


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

    @classmethod
    def of(cls, spec: ActionSpec) -> ActionEntry:
        """The entry of a task's actions."""
        return cls(**dataclasses.asdict(spec), jaw="binary")

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


class ChainingEntry(Table):
    """The chaining policy: its graph for every skill but the last, by the skill's name."""

    graphs: dict[str, str]


class ValueEntry(Table):
    """The value at every skill's start: graphs by the skill's name, and what counts as low.

    `meaning`: a "probability" of the whole task's success, one for every skill; or a "return", the
    action value of a chaining policy as it was learned, which is no probability and is shown as it
    is, one for every skill but the last.
    """

    graphs: dict[str, str]
    threshold: float | None = Field(default=None, ge=0, le=1)
    meaning: Literal["probability", "return"] = "probability"


class TrainingRange(Table):
    """Smallest and largest value of every observation entry seen in training."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]

    @property
    def seen(self) -> ObservationRange:
        """The same for the gate (S29)."""
        return ObservationRange(self.lower, self.upper)


class Measured(Table):
    """A success figure with the command that gave it."""

    distribution: str
    mode: str
    episodes: int = Field(gt=0)
    success_rate: float = Field(ge=0, le=1)
    command: str


class Manifest(Table):
    """`manifest.json`. Frames: task frame; control point: the jaw pivot; lengths in metres.

    That is what the runtime gives and takes; graphs that want something else have an `adapter`.
    """

    schema_version: Literal[1] = Field(alias="schema")
    name: str = Field(pattern=NAME, max_length=100)
    task: str
    cell: str
    method: str
    created_by: str
    arms: tuple[ArmEntry, ...]
    frame: Literal["task"]
    control_point: Literal["jaw_pivot"]
    length_unit: Literal["m"]
    adapter: AdapterEntry | None = None
    step_s: Positive
    action: ActionEntry
    observation: tuple[LayoutEntry, ...]
    goal: tuple[LayoutEntry, ...]
    skills: tuple[SkillEntry, ...] = Field(min_length=1)
    subgoals: Literal["scripted", "chaining"]
    chaining: ChainingEntry | None = None
    value: ValueEntry | None = None
    training_range: TrainingRange
    seeds: tuple[int, ...]
    measured: tuple[Measured, ...]
    files: dict[str, str]
    digest: str = ""

    @property
    def graphs(self) -> tuple[str, ...]:
        """Every file that is a graph."""
        tables = [table.graphs for table in (self.chaining, self.value) if table is not None]
        return (
            *(skill.file for skill in self.skills),
            *(file for table in tables for file in table.values()),
        )

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
        skills: (observation, subgoal) → action, by skill name.
        chaining: (observation, task's goal) → positions, by the name of the skill that they are
            for; empty when the scripted plan gives the subgoals.
        values: (observation, task's goal, subgoal) → P(the whole task succeeds), by skill name;
            empty when the bundle tells none.
    """

    path: Path
    manifest: Manifest
    skills: dict[str, Graph]
    chaining: dict[str, Graph]
    values: dict[str, Graph]


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
    target = folder / MANIFEST
    target.write_text(sealed(content), encoding="utf-8")
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
    unused = {name for name in contents if name.endswith(".onnx")} - set(manifest.graphs)
    if unused:
        raise BundleError(folder, f"lists {sorted(unused)}, which no skill uses; remove them")
    obs, goal = {"obs": manifest.observation_size}, manifest.goal_size
    seen = obs | {"task_goal": TASK_GOAL_SIZE}

    between = _adapters(manifest)

    def opened(graphs: dict[str, str], signature: Signature, outward: str = "") -> dict[str, Graph]:
        found = {}
        for skill, file in graphs.items():
            graph = open_graph(folder / file, _listed(folder, contents, file), signature)
            found[skill] = graph.adapted(between, between.get(outward))
        return found

    return Bundle(
        folder,
        manifest,
        opened(
            {skill.name: skill.file for skill in manifest.skills},
            Signature(obs | {"goal": goal}, "action", 5 * len(manifest.arms)),
        ),
        opened(
            manifest.chaining.graphs if manifest.chaining else {},
            Signature(seen, "subgoal", CHOSEN_SIZE),
            outward="chosen",
        ),
        opened(
            manifest.value.graphs if manifest.value else {},
            Signature(seen | {"subgoal": goal}, "value", 1),
        ),
    )


def _adapters(manifest: Manifest) -> Mapping[str, Affine]:
    if manifest.adapter is None:
        return {}
    observation, goal = (
        [(entry.name, entry.size) for entry in part]
        for part in (manifest.observation, manifest.goal)
    )
    return adapters(manifest.adapter, observation, goal, CHOSEN_SIZE)


def read_manifest(folder: Path) -> Manifest:
    """The manifest of a bundle, its digest checked; raises BundleError."""
    path = folder / MANIFEST
    if not path.is_file():
        raise BundleError(folder, f"holds no {MANIFEST}; name the folder of a policy bundle")
    try:
        manifest = Manifest.model_validate(read_sealed(path, MAX_MANIFEST_BYTES))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise BundleError(path, f"{key}: {first['msg']}; export the bundle again") from error
    except (OSError, ValueError) as error:
        raise BundleError(path, f"{error}; fetch or export the bundle again") from error
    _check_sizes(path, manifest)
    return manifest


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
    _check_graphs(path, manifest)


def _check_graphs(path: Path, manifest: Manifest) -> None:
    """Holds the chaining policy's and the value's tables against the skills."""
    names = [skill.name for skill in manifest.skills]
    if (manifest.subgoals == "chaining") != (manifest.chaining is not None):
        raise BundleError(path, 'subgoals: "chaining" and a chaining table need each other')
    if manifest.chaining is not None:
        _check_names(path, "chaining", manifest.chaining.graphs, names[:-1], chain_file)
        if manifest.goal_size < CHOSEN_SIZE:
            raise BundleError(path, f"goal: chaining needs the {CHOSEN_SIZE} numbers of positions")
    if manifest.value is not None:
        valued = names if manifest.value.meaning == "probability" else names[:-1]
        _check_names(path, "value", manifest.value.graphs, valued, value_file)
        if (manifest.value.threshold is None) != (manifest.value.meaning == "return"):
            raise BundleError(
                path, "value: a probability needs a threshold, a return has none; export it again"
            )


def _check_names(
    path: Path, table: str, graphs: dict[str, str], skills: list[str], name: Callable[[str], str]
) -> None:
    expected = {skill: name(skill) for skill in skills}
    if graphs != expected:
        raise BundleError(
            path, f"{table}.graphs is {graphs}, has to be {expected}; export the bundle again"
        )


def _checked_files(folder: Path, manifest: Manifest) -> dict[str, bytes]:
    contents: dict[str, bytes] = {}
    for name, expected in manifest.files.items():
        path = folder / name
        if Path(name).name != name or name in {"", ".", ".."} or path.is_symlink():
            raise BundleError(path, "leaves the bundle's folder; refuse this bundle")
        if path.suffix not in KINDS:
            raise BundleError(
                path, f"is no file for a bundle ({', '.join(sorted(KINDS))}); remove it"
            )
        if not path.is_file():
            raise BundleError(path, "is listed in the manifest but missing; fetch it again")
        if path.stat().st_size > MAX_FILE_BYTES:
            raise BundleError(path, "is larger than a bundle's file may be; export it again")
        contents[name] = path.read_bytes()
        if sum(map(len, contents.values())) > MAX_BUNDLE_BYTES:
            raise BundleError(folder, "is larger than a bundle may be; export it again")
        if hashlib.sha256(contents[name]).hexdigest() != expected:
            raise BundleError(path, "was changed after export (SHA-256); fetch the bundle again")
    unlisted = {entry.name for entry in folder.iterdir()} - set(contents) - {MANIFEST}
    if unlisted:
        raise BundleError(folder, f"holds unlisted {sorted(unlisted)}; remove them")
    return contents


def _listed(folder: Path, contents: dict[str, bytes], name: str) -> bytes:
    if name not in contents:
        raise BundleError(
            folder / name, "is named but not listed in the manifest's files; export again"
        )
    return contents[name]
