"""What a recording holds, as arrays and rows."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from viskill_deploy.core.types import FloatArray


@dataclass(frozen=True, slots=True)
class Track:
    """Joint positions over time.

    Attributes:
        time_s: log time, s since the start of the recording, (n,).
        position: rad or m, (n, joints).
        velocity: rad/s or m/s, (n, joints).
    """

    time_s: FloatArray
    position: FloatArray
    velocity: FloatArray


@dataclass(frozen=True, slots=True)
class PoseTrack:
    """Poses in the task frame over time.

    Attributes:
        time_s: log time, s since the start of the recording, (n,).
        position: m, (n, 3).
        orientation: unit quaternion x, y, z, w, (n, 4).
    """

    time_s: FloatArray
    position: FloatArray
    orientation: FloatArray


@dataclass(frozen=True, slots=True)
class VerdictRow:
    """One verdict with the time at which it was given and the mode of the gate."""

    time_s: float
    action: int
    rule: str
    arm: int
    joint: int
    value: float
    limit: float
    mode: str


@dataclass(frozen=True, slots=True)
class Mark:
    """One mark in the run.

    Attributes:
        subgoal: what the skill was told to reach, with its first step; () with others.
        subgoal_source: who gave it.
        value: P(the whole task succeeds) as seen then; None where nothing told it.
        boundary: what was seen and decided before a skill's first step (`core.types.Boundary` as
            a dict); None with other marks.
    """

    time_s: float
    episode: int
    skill: str
    step: int
    note: str
    subgoal: tuple[float, ...] = ()
    subgoal_source: str = ""
    value: float | None = None
    boundary: dict[str, Any] | None = None


@dataclass(frozen=True)
class RunData:
    """A recording, or one episode of it.

    Attributes:
        about: cell, arms, robots, tools, period and files (path, SHA-256) as the recorder was told.
        origin_ns: Unix time of `time_s` = 0, ns.
        joints: tracks by topic, such as "/PSM1/jaw/setpoint_js".
        poses: tracks by topic, such as "/PSM1/measured_cp" or "/scene/block0".
        verdicts: in order of time; one with rule "" for each cycle in which no rule spoke.
        marks: in order of time.
        complete: False when the recorder was cut off.
    """

    about: dict[str, Any]
    origin_ns: int
    joints: dict[str, Track] = field(default_factory=dict)
    poses: dict[str, PoseTrack] = field(default_factory=dict)
    verdicts: tuple[VerdictRow, ...] = ()
    marks: tuple[Mark, ...] = ()
    complete: bool = True

    @property
    def duration_s(self) -> float:
        """Time from the first to the last cycle, s."""
        times = [track.time_s for track in self.joints.values() if len(track.time_s)]
        return max((float(t[-1] - t[0]) for t in times), default=0.0)
