"""Messages gathered by topic and decoded: the inside of `reading`."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from viskill_deploy.core.types import FloatArray
from viskill_deploy.observe import messages
from viskill_deploy.observe.mcap_runs import Run
from viskill_deploy.observe.records import Mark, PoseTrack, Track, VerdictRow

Times = npt.NDArray[np.int64]
_END = 2**63 - 1


class Gathered:
    """The runs of one episode (or of all) by topic.

    Attributes:
        over: a mark of another episode came after the wanted one, so that nothing can follow.
        episodes: episodes seen so far.
    """

    def __init__(self, episode: int | None) -> None:
        self.over = False
        self.episodes: list[int] = []
        self._episode = episode
        self._start = 0 if episode is None else _END
        self._end = _END
        self._runs: dict[str, list[Run]] = {}
        self._marks: list[tuple[int, Mark]] = []

    def take(self, runs: Iterable[Run]) -> None:
        """Takes the runs of one chunk."""
        runs = list(runs)
        for run in runs:
            if run.topic == "/skill":
                for log, row in zip(run.log_ns.tolist(), run.data, strict=True):
                    self._mark(log, row.tobytes())
        for run in runs:
            if run.topic != "/skill" and run.log_ns[-1] >= self._start:
                self._runs.setdefault(run.topic, []).append(run)

    def _mark(self, log: int, message: bytes) -> None:
        told = json.loads(_string(message, 0)[0])
        mark = Mark(time_s=0.0, **told | {"subgoal": tuple(told.get("subgoal", ()))})
        if mark.episode not in self.episodes:
            self.episodes.append(mark.episode)
        if self._episode in {None, mark.episode}:
            self._start = min(self._start, log)
            self._marks.append((log, mark))
        elif self._start < log:
            self._end, self.over = min(self._end, log), True

    def _column(self, runs: list[Run]) -> list[tuple[Run, npt.NDArray[np.bool_]]]:
        return [(run, (run.log_ns >= self._start) & (run.log_ns < self._end)) for run in runs]

    def tracks(self, kind: messages.MessageType) -> dict[str, list[tuple[Times, FloatArray]]]:
        """Per topic of type `kind`: log times (n,) and numbers (n, k) of each run."""
        decode = {messages.JOINT_STATE: _joints, messages.POSE_STAMPED: _poses}[kind]
        return {
            topic: [(run.log_ns[keep], decode(run.data)[keep]) for run, keep in self._column(runs)]
            for topic, runs in self._runs.items()
            if runs[0].type == kind.name
        }

    def origin_ns(self) -> int:
        """The first log time that is kept."""
        times = [
            int(run.log_ns[keep][0])
            for runs in self._runs.values()
            for run, keep in self._column(runs)
            if keep.any()
        ]
        return min([*times, *(log for log, _ in self._marks)], default=0)

    def marks(self, origin: int) -> tuple[Mark, ...]:
        """Marks in order of time."""
        return tuple(
            replace(mark, time_s=(log - origin) * 1e-9)
            for log, mark in sorted(self._marks, key=lambda entry: entry[0])
        )

    def verdicts(self, origin: int) -> tuple[VerdictRow, ...]:
        """Verdicts in order of time."""
        rows = [
            _verdict((log - origin) * 1e-9, row.tobytes())
            for run, keep in self._column(self._runs.get("/safety/verdict", []))
            for log, row in zip(run.log_ns[keep].tolist(), run.data[keep], strict=True)
        ]
        return tuple(sorted(rows, key=lambda row: row.time_s))


def joint_track(parts: list[tuple[Times, FloatArray]], origin: int) -> Track:
    """A joint track out of its runs."""
    log, values = _joined(parts)
    half = values.shape[1] // 2
    return Track(_seconds(log, origin), values[:, :half], values[:, half:])


def pose_track(parts: list[tuple[Times, FloatArray]], origin: int) -> PoseTrack:
    """A pose track out of its runs."""
    log, values = _joined(parts)
    return PoseTrack(_seconds(log, origin), values[:, :3], values[:, 3:])


def _seconds(log: Times, origin: int) -> FloatArray:
    return np.asarray((log - origin) * 1e-9, dtype=np.float64)


def _joined(parts: list[tuple[Times, FloatArray]]) -> tuple[Times, FloatArray]:
    log = np.concatenate([times for times, _ in parts])
    return log, np.concatenate([values for _, values in parts])


def _doubles(data: npt.NDArray[np.uint8], at: int, count: int) -> FloatArray:
    return np.ascontiguousarray(data[:, at : at + 8 * count]).view("<f8")


def _string(message: bytes, at: int) -> tuple[str, int]:
    """The string at the next multiple of four, and where it ends."""
    at += -at % 4
    (size,) = struct.unpack_from("<I", message, at)
    return message[at + 4 : at + 3 + size].decode(), at + 4 + size


def _joints(data: npt.NDArray[np.uint8]) -> FloatArray:
    """Positions and velocities of JointState messages of one size, (n, 2 joints)."""
    first = data[0].tobytes()
    _, at = _string(first, 8)
    at += -at % 4
    (count,) = struct.unpack_from("<I", first, at)
    at += 4
    for _ in range(count):
        _, at = _string(first, at)
    columns = []
    for _ in range(2):
        at += 4 + -at % 4  # the count of the sequence
        at += -at % 8
        columns.append(_doubles(data, at, count))
        at += 8 * count
    return np.concatenate(columns, axis=1)


def _poses(data: npt.NDArray[np.uint8]) -> FloatArray:
    """Position and quaternion of PoseStamped messages of one size, (n, 7)."""
    _, at = _string(data[0].tobytes(), 8)
    return _doubles(data, at + -at % 8, 7)


def _verdict(time_s: float, message: bytes) -> VerdictRow:
    _, at = _string(message, 8)
    action = message[at]
    rule, at = _string(message, at + 1)
    arm, joint = struct.unpack_from("<bb", message, at)
    at += 2
    value, limit = struct.unpack_from("<dd", message, at + -at % 8)
    mode, _ = _string(message, at + -at % 8 + 16)
    return VerdictRow(time_s, action, rule, arm, joint, value, limit, mode)
