"""The runtime's side of the recorder: it packs a frame a cycle and writes it to a pipe.

Every cycle leaves a record (S32): what was measured, asked and sent, and what each rule said. All
costly work is done by a process of its own (`recorder_process`), which closes the bag properly
even when the runtime is killed.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import select
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from viskill_deploy.core import clock, data
from viskill_deploy.core.description import CellDescription
from viskill_deploy.core.errors import RecordingError
from viskill_deploy.core.types import (
    Action,
    ArmState,
    Boundary,
    CellState,
    FloatArray,
    Joints,
    JointSetpoint,
    Mode,
    Request,
    Scene,
    SkillStart,
    Verdict,
)
from viskill_deploy.observe import frames
from viskill_deploy.observe.frames import HEADER, Kind

PIPE_BYTES = 1 << 20
"""Asked of the kernel: about a thousand cycles of two arms, four seconds at 250 Hz."""

OPEN_S = 20.0
"""A recorder that has not opened its file after this time will not."""

SCENE_PERIOD_S = 0.02
_F_SETPIPE_SZ = getattr(fcntl, "F_SETPIPE_SZ", None)


class Recorder:
    """Writes a run to the rosbag2 bag `path` (a folder, made new) by a process of its own.

    Args:
        path: folder of the bag.
        cell: the cell that runs.
        period_s: control period, s.
        patience_s: longest that one call waits while the pipe is full, s. A simulated run goes
            faster than real time and has to wait at times; a recorder that is this late is dead.
        files: path and SHA-256 of every data file that the run uses; by default, of the cell's.

    Raises:
        RecordingError: `path` exists already, or the process cannot be started.
    """

    def __init__(
        self,
        path: Path,
        cell: CellDescription,
        period_s: float,
        patience_s: float = 1.0,
        files: Sequence[tuple[str, str]] = (),
    ) -> None:
        self.path = Path(path)
        self._patience_ms = patience_s * 1e3
        self._failed = False
        self._started = False
        self._scene_due_s = -math.inf
        self._failure = ""
        self._arms = len(cell.arms)
        self._joints = len(cell.arms[0].arm.joints)
        self._nothing = (math.nan,) * frames.track_size(self._joints)
        self._cycle = frames.cycle_struct(self._arms, self._joints)
        self._no_poses = bytes(self._arms * 128)
        self._cycle_bytes = self._cycle.size + len(self._no_poses) - HEADER.size
        files = files or data.digests(cell.files)  # may fail, and then nothing was begun
        self._process, self._pipe = _start(self.path)
        self._poll = select.poll()
        self._poll.register(self._pipe, select.POLLOUT)
        hello = {
            "cell": cell.name,
            "arms": [arm.name for arm in cell.arms],
            "robots": [arm.arm.robot for arm in cell.arms],
            "tools": [arm.arm.tool for arm in cell.arms],
            "joints": cell.arms[0].arm.joint_names,
            "period_s": period_s,
            "files": files,
        }
        self._send(Kind.HELLO, json.dumps(hello).encode())

    @property
    def alive(self) -> bool:
        """Whether the record is being kept; when False the gate has to stop the run (S32).

        A recorder that died breaks the pipe, so the next write notices: no need to ask the system.
        """
        return not self._failed

    @property
    def process_id(self) -> int:
        """The recorder's process."""
        return self._process.pid

    def wait_until_open(self, timeout_s: float = OPEN_S) -> None:
        """Waits until the bag is on disk, so that nothing moves before it can be recorded.

        Raises:
            RecordingError: the recorder's process ended instead, or took too long.
        """
        bag = self.path / f"{self.path.name}_0.mcap"
        waiting = clock.MonotonicClock()
        deadline = waiting.now() + timeout_s
        while not (bag.is_file() and bag.stat().st_size > 0):
            if self._process.poll() is not None or waiting.now() > deadline:
                raise RecordingError(
                    f"{self.path}: the recorder could not open its file; look for its message "
                    "above and for free disk space"
                )
            waiting.sleep_until(waiting.now() + 0.005)

    def cycle(
        self,
        now: float,
        state: CellState,
        request: Request,
        sent: Sequence[JointSetpoint],
        action: Action,
        verdicts: Sequence[Verdict],
        mode: Mode,
        tip_poses: Sequence[FloatArray] | None,
    ) -> None:
        """Records one control cycle.

        Args:
            now: driver's clock, s.
            state: what the driver reported.
            request: what the line asked for.
            sent: what the gate sent, one an arm; empty when nothing was sent, and then the
                setpoint that the driver holds is recorded.
            action: what the gate did.
            verdicts: every rule that spoke; without any, one verdict with rule "" is recorded.
            mode: mode of the gate.
            tip_poses: measured tip poses in the task frame, (4, 4) each, or None.
        """
        self._begin(now)
        asked = request.setpoints
        flags = (frames.ASKED if asked else 0) | (frames.POSED if tip_poses else 0)
        flags |= 0 if verdicts else frames.QUIET
        values: list[float] = []
        for index, arm in enumerate(state.arms):
            values.append(arm.stamp_s)
            values += self._all(arm.measured_jp) + self._all(arm.measured_jv)
            values += arm.jaw_measured_jp, arm.jaw_measured_jv
            values += self._track(sent[index]) if sent else self._held(arm)
            values += self._track(asked[index]) if asked else self._nothing
        poses = b"".join([T.tobytes() for T in tip_poses]) if tip_poses else self._no_poses
        mode_index = frames.MODE_INDEX[mode]
        head = (Kind.CYCLE, self._cycle_bytes, now, action, mode_index, flags)
        self._write(self._cycle.pack(*head, *values) + poses)
        for verdict in verdicts:
            self._verdict(now, verdict, mode_index)
        if request.failure != self._failure:
            self._failure = request.failure
            self._send(Kind.FAILURE, frames.TEXT.pack(now) + request.failure.encode())

    def scene(self, now: float, scene: Scene) -> None:
        """Records where the things on the board are, at most every 20 ms."""
        if now < self._scene_due_s - 1e-6:
            return
        self._scene_due_s = now + SCENE_PERIOD_S
        self._begin(now)
        goal = np.eye(4)
        goal[:3, 3] = scene.goal
        things = [(thing.name, thing.T_task_object) for thing in scene.objects]
        written = []
        for name, pose in (*things, ("goal", goal)):
            payload = frames.POSE.pack(scene.stamp_s, pose.tobytes()) + name.encode()
            written += [HEADER.pack(Kind.POSE, len(payload)), payload]
        self._write(b"".join(written))

    def mark(
        self,
        now: float,
        episode: int,
        skill: str,
        step: int,
        note: str = "",
        start: SkillStart | None = None,
        boundary: Boundary | None = None,
    ) -> None:
        """Records where the run stands: episode, skill, policy step, and a remark.

        With a skill's first step also what was decided there, `start`. Before it, what was decided
        about going on to the skill, `boundary`.
        """
        self._begin(now)
        told: dict[str, Any] = {"episode": episode, "skill": skill, "step": step, "note": note}
        if start is not None:
            told |= {"subgoal": start.subgoal.tolist(), "subgoal_source": start.source}
            told["value"] = start.value
        if boundary is not None:
            told["boundary"] = asdict(boundary)
        self._send(Kind.SKILL, frames.TEXT.pack(now) + json.dumps(told).encode())

    def close(self) -> None:
        """Waits until the bag is complete.

        Raises:
            RecordingError: the recorder failed, so that the bag is not complete.
        """
        if self._pipe < 0:
            return
        os.close(self._pipe)
        self._pipe = -1
        if self._process.wait() != 0 or self._failed:
            raise RecordingError(
                f"{self.path}: the recorder ended early (exit code {self._process.returncode}); "
                "the bag holds the time before. Look for its message above and for free disk space"
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None:
            self.close()
            return
        with contextlib.suppress(RecordingError):  # the first error is the one to tell
            self.close()

    def _begin(self, now: float) -> None:
        """Ties the driver's clock to the date, once, so that viewers can show it."""
        if not self._started:
            self._started = True
            self._send(Kind.ORIGIN, frames.ORIGIN.pack(round(clock.wall_time() * 1e9), now))

    def _verdict(self, now: float, verdict: Verdict, mode: int) -> None:
        self._send(
            Kind.VERDICT,
            frames.VERDICT.pack(
                now,
                verdict.action,
                mode,
                verdict.arm,
                verdict.joint,
                verdict.rule.encode(),
                verdict.value,
                verdict.limit,
            ),
        )

    def _all(self, joints: Joints) -> Joints:
        """A number for each joint, whatever a faulty driver reported."""
        count = self._joints
        return joints if len(joints) == count else (*joints, *self._nothing)[:count]

    def _track(self, s: JointSetpoint) -> tuple[float, ...]:
        return (*self._all(s.jp), *self._all(s.jv), s.jaw, s.jaw_v)

    def _held(self, arm: ArmState) -> tuple[float, ...]:
        """The setpoint that the driver holds, at rest."""
        rest = (0.0,) * self._joints
        return (*self._all(arm.setpoint_jp), *rest, arm.jaw_setpoint_jp, 0.0)

    def _send(self, kind: Kind, payload: bytes) -> None:
        self._write(HEADER.pack(kind, len(payload)) + payload)

    def _write(self, frame: bytes) -> None:
        """Writes a frame; a recorder that is gone or late for too long counts as failed."""
        while frame and not self._failed:
            try:
                frame = frame[os.write(self._pipe, frame) :]
            except BlockingIOError:
                self._failed = not self._poll.poll(self._patience_ms)
            except OSError:
                self._failed = True


def _start(folder: Path) -> tuple[subprocess.Popen[bytes], int]:
    """The recorder's process and the writing end of its pipe."""
    try:
        folder.mkdir(parents=True)
    except FileExistsError as error:
        raise RecordingError(f"{folder}: exists already; name a new folder") from error
    reader, writer = os.pipe2(os.O_CLOEXEC)
    if _F_SETPIPE_SZ is not None:
        with contextlib.suppress(OSError):  # above this user's limit: the pipe stays smaller
            fcntl.fcntl(writer, _F_SETPIPE_SZ, PIPE_BYTES)
    os.set_blocking(writer, False)
    module = "viskill_deploy.observe.recorder_process"
    try:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", module, str(folder)],
            stdin=reader,
            stdout=subprocess.DEVNULL,
            start_new_session=True,  # a Ctrl-C is for the runtime; the record goes on to the end
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
        )
    except OSError as error:
        os.close(writer)
        raise RecordingError(f"{folder}: the recorder does not start ({error})") from error
    finally:
        os.close(reader)
    return process, writer
