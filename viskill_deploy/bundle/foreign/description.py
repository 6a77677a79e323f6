"""The TOML that says what a policy's numbers mean, held against a task; names lines at fault."""

from __future__ import annotations

import math
import re
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import Field, ValidationError

from viskill_deploy.core.errors import DataFileError
from viskill_deploy.core.robot_files import Positive, Table, Vector3
from viskill_deploy.sim.tasks.base import Layout, Task

Frame = Literal["task", "world", "surrol"]
SUBGOAL = "subgoal."
"""What comes before the name of a stretch of the subgoal."""

TARGETS = (SUBGOAL, "grasp")
"""How names of the places begin where the task wants a tip; they are jaw pivots, or a thing's."""


class Observation(Table):
    """What the policy sees: its input's name, and stretches of the task's vectors in order."""

    input: str
    layout: tuple[str, ...] = Field(min_length=1)


class Action(Table):
    """What the policy answers, per arm: three numbers of position, one of rotation, one of the jaw.

    Attributes:
        output: name of the graph's output.
        reference: "setpoint" or "measured": displacements, 1.0 is `displacement_m`, added to the
            last waypoint or to what is measured. "absolute": positions in the frame.
        displacement_m: length of 1.0, real metres; with "absolute", how far one step may lead on
            one axis.
        max_displacement_m: a step is shortened to this.
        rotation: "none": there is no such number. "increment": 1.0 turns by `rotation_rad`.
            "absolute": the angle itself, rad.
        rotation_rad: turn of 1.0; with "absolute", how far one step may turn.
        jaw: "binary": below 0 closes. "angle": an opening, rad, that closes below half of
            `jaw_open_rad`.
    """

    output: str
    reference: Literal["setpoint", "measured", "absolute"]
    displacement_m: Positive
    max_displacement_m: Positive
    rotation: Literal["none", "increment", "absolute"]
    rotation_rad: Positive = 0.5
    jaw: Literal["binary", "angle"]
    jaw_open_rad: Positive


class PolicyFile(Table):
    """`<policy>.toml` beside an ONNX file."""

    schema_version: Literal[1] = Field(alias="schema")
    task: str
    rate_hz: Positive
    arms: tuple[str, ...]
    tools: tuple[str, ...]
    frame: Frame
    control_point: Literal["jaw-pivot", "jaw-end"]
    length_scale: Positive | None = None
    observation: Observation
    action: Action


class Description:
    """A policy file that fits a task.

    Args:
        path: of the file.

    Attributes:
        file: what it says.

    Raises:
        DataFileError: an entry is unknown, missing or of the wrong kind; names its line.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self._text = path.read_text(encoding="utf-8")
            self.file = PolicyFile.model_validate(tomllib.loads(self._text))
        except ValidationError as error:
            first = error.errors()[0]
            names = [part for part in first["loc"] if isinstance(part, str)]
            reason = first["msg"]
            if first["type"] == "extra_forbidden":
                reason = "unknown entry; check its spelling"
            raise self.fault(names[-1] if names else "", reason, ".".join(names)) from error
        except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
            raise DataFileError(path, "", f"cannot be read as TOML ({error})") from error

    def fault(self, word: str, reason: str, key: str = "") -> DataFileError:
        """A refusal that names the line in which a key or a text stands."""
        pattern = re.compile(
            rf'^\s*{re.escape(word)}\s*=|"{re.escape(word)}"|^\[{re.escape(word)}\]'
        )
        lines = self._text.splitlines()
        found = [i for i, line in enumerate(lines, 1) if word and pattern.search(line)]
        where = f"line {found[0]}, {key or word}" if found else (key or word)
        return DataFileError(self.path, where, reason)

    def check(self, task: Task) -> None:
        """Refuses what does not fit the task; raises DataFileError with the line."""
        file, cell = self.file, task.cell
        step_s = cell.file.motion.step_s
        if abs(1.0 / file.rate_hz - step_s) > 1e-9:
            raise self.fault("rate_hz", f"{cell.name} takes a step each {step_s} s: {1 / step_s:g}")
        for key, theirs, ours in (
            ("arms", file.arms, tuple(arm.name for arm in cell.arms)),
            ("tools", file.tools, tuple(arm.entry.tool for arm in cell.arms)),
        ):
            if theirs != ours:
                raise self.fault(key, f"{cell.name} has {', '.join(ours)}; mount those, or retrain")
        if file.frame != "task" and cell.file.surrol is None:
            raise self.fault("frame", f"{cell.name} does not say where that world is")
        known = dict(_stretches(task))
        for name in file.observation.layout:
            if name not in known:
                raise self.fault(name, f"no such stretch; there are {', '.join(known)}")
        if file.action.rotation_rad > math.pi:
            raise self.fault("rotation_rad", "is more than half a turn; give radians a step")

    def width(self, task: Task) -> int:
        """Numbers that the policy sees."""
        sizes = dict(_stretches(task))
        return sum(sizes[name] for name in self.file.observation.layout)

    @property
    def pivots(self) -> tuple[str, ...]:
        """Targets that a policy about jaw ends sees; the task has them about jaw pivots."""
        seen = self.file.observation.layout if self.file.control_point == "jaw-end" else ()
        return tuple(n for n in seen if n.startswith(TARGETS) and n.endswith("_position"))

    @property
    def per_arm(self) -> int:
        """Numbers that the policy answers for one arm."""
        return 4 if self.file.action.rotation == "none" else 5

    def world(self, task: Task) -> tuple[float, Vector3]:
        """Length scale and origin of the task frame in the policy's frame."""
        world = task.cell.file.surrol
        if self.file.frame == "task" or world is None:
            return self.file.length_scale or 1.0, (0.0, 0.0, 0.0)
        usual = world.length_scale if self.file.frame == "surrol" else 1.0
        return self.file.length_scale or usual, world.task_origin_m


def _stretches(task: Task) -> Sequence[tuple[str, int]]:
    """Everything that a policy may ask to see."""
    subgoal: Layout = tuple((SUBGOAL + name, size) for name, size in task.goal_layout)
    return (*task.observation_layout, *subgoal)
