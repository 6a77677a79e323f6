"""Reads recordings: what the report and the video are made from."""

from __future__ import annotations

import json
from pathlib import Path

from viskill_deploy.core.errors import RecordingError
from viskill_deploy.observe.gathering import Gathered, joint_track, pose_track
from viskill_deploy.observe.mcap_runs import RunFile
from viskill_deploy.observe.messages import JOINT_STATE, POSE_STAMPED
from viskill_deploy.observe.records import RunData


def mcap_of(path: Path) -> Path:
    """The .mcap file of a bag's folder, or `path` itself.

    Raises:
        RecordingError: there is none.
    """
    if path.is_file():
        return path
    found = sorted(path.glob("*.mcap"))
    if not found:
        raise RecordingError(f"{path}: holds no .mcap file; name the folder of a recording")
    return found[0]


def read_recording(path: Path, episode: int | None = None) -> RunData:
    """The recording `path` (a bag's folder or its .mcap), or one episode of it.

    Raises:
        RecordingError: no recording, or damaged.
    """
    file = RunFile(mcap_of(Path(path)))
    gathered = Gathered(episode)
    for runs in file.chunks():
        gathered.take(runs)
        if gathered.over:
            break
    if episode is not None and episode not in gathered.episodes:
        raise RecordingError(
            f"{path}: no episode {episode}; ask for one of {gathered.episodes or 'none at all'}"
        )
    origin = gathered.origin_ns()
    return RunData(
        about=json.loads(file.metadata.get("hello", "{}")),
        origin_ns=origin,
        joints={t: joint_track(p, origin) for t, p in gathered.tracks(JOINT_STATE).items()},
        poses={t: pose_track(p, origin) for t, p in gathered.tracks(POSE_STAMPED).items()},
        verdicts=gathered.verdicts(origin),
        marks=gathered.marks(origin),
        complete=file.complete or gathered.over,
    )
