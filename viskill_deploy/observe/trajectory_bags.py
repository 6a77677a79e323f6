"""Trajectories in bags of any program: poses of every arm, and its jaw beside them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.rosbag2 import ReaderError
from rosbags.typesys import Stores, get_typestore

from viskill_deploy.core.errors import MotionError
from viskill_deploy.core.types import FloatArray
from viskill_deploy.motion.frames import ARM_FRAMES, Frame, Label
from viskill_deploy.motion.trajectory import ArmPath, Written
from viskill_deploy.observe.mcap_runs import RunFile
from viskill_deploy.observe.trajectory_labels import label_of

POSE_TOPICS = ("setpoint_cp", "servo_cp", "move_cp", "measured_cp")
JAW_TOPICS = ("setpoint_js", "servo_jp", "move_jp", "measured_js")
"""Of an arm, and of its jaw: the first that a bag has is taken."""

WANTED = re.compile(
    rf"/(\w+)/(?:(?:local/)?(?:{'|'.join(POSE_TOPICS)})|jaw/(?:{'|'.join(JAW_TOPICS)}))"
)

PAIRED = 0.2
"""Rows of two arms may differ by this part of a step, and be of one moment."""

JAW_NEAR = 1.1
"""A jaw's message may be this many steps from its pose."""

ONE_ROW_NS = 10**8
"""Stands for the step of a bag with one row."""

Stamps = npt.NDArray[np.int64]
Track = tuple[list[int], list[list[float]]]
"""Times, ns, and numbers of the messages of one topic."""


def read_bag(path: Path, arms: Sequence[str] = (), frame: Frame | None = None) -> Written:
    """PoseStamped of every arm, and its jaw's JointState nearest in time.

    Args:
        path: an MCAP file, a ROS 1 bag, or the folder of a rosbag2.
        arms: the arms to read; other topics are passed over. All that are there when empty.
        frame: where the poses are seen from, where the bag does not say it. For the frames of an
            arm, topics below `local/` come first; for the others they are not used.

    Raises:
        MotionError: no bag; an arm lacks poses or a jaw; rows of two arms, or a pose and its jaw,
            are not of one moment.
    """
    tracks, others = _tracks(path, arms)
    label = _label(path)
    frame = label.frame if label else frame
    notes = [f"left out, no arms of this cell: {', '.join(others)}"] if others else []
    paths: dict[str, ArmPath] = {}
    stamps: dict[str, Stamps] = {}
    for name in dict.fromkeys(topic.split("/")[1] for topic in tracks):
        places = _pose_topics(name, frame)
        pose = _first(tracks, places)
        jaw = _first(tracks, [f"/{name}/jaw/{t}" for t in JAW_TOPICS])
        if pose is None or jaw is None:
            raise MotionError(
                f"{path}: {name} needs a PoseStamped topic ({', '.join(places)}) and a jaw's "
                f"JointState (/{name}/jaw/ and {', '.join(JAW_TOPICS)})"
            )
        notes.append(f"{name}: poses of {pose}, jaw of {jaw}")
        if label is None and frame in ARM_FRAMES and "/local/" not in pose:
            notes.append(
                f"{name}: has nothing below local/; is {pose} seen from the remote centre?"
            )
        times, numbers = _arrays(tracks[pose])
        paths[name] = ArmPath(
            numbers[:, :3], numbers[:, 3:], _jaw(path, pose, jaw, times, _arrays(tracks[jaw]))
        )
        stamps[name] = times
    time_s = _common_times(path, stamps) if stamps else None
    return Written(time_s, paths, label, tuple(notes))


def _tracks(path: Path, arms: Sequence[str]) -> tuple[dict[str, Track], list[str]]:
    """The messages by topic, and the names of arms that were passed over."""
    tracks: dict[str, Track] = {}
    others: dict[str, None] = {}
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            chosen = []
            for connection in reader.connections:
                if found := WANTED.fullmatch(connection.topic):
                    if arms and found[1] not in arms:
                        others[found[1]] = None
                    else:
                        chosen.append(connection)
            for connection, log_ns, raw in reader.messages(connections=chosen) if chosen else ():
                message: Any = reader.deserialize(raw, connection.msgtype)
                stamp = message.header.stamp
                times, rows = tracks.setdefault(connection.topic, ([], []))
                times.append(stamp.sec * 10**9 + stamp.nanosec or log_ns)
                rows.append(_numbers(message))
    except (AnyReaderError, ReaderError, OSError, ValueError, LookupError, AttributeError) as error:
        raise MotionError(f"{path}: cannot be read as a bag ({error})") from error
    return tracks, sorted(others)


def _pose_topics(arm: str, frame: Frame | None) -> list[str]:
    """Where an arm's poses may be, best first: `measured_cp` itself may be in any frame."""
    plain = [f"/{arm}/{topic}" for topic in POSE_TOPICS]
    if frame is not None and frame not in ARM_FRAMES:
        return plain
    return [*(f"/{arm}/local/{topic}" for topic in POSE_TOPICS), *plain]


def _jaw(
    path: Path, pose: str, jaw: str, times: Stamps, messages: tuple[Stamps, FloatArray]
) -> FloatArray:
    """The jaw's angle at every pose, rad, (n,)."""
    order = np.argsort(messages[0], kind="stable")
    stamps, numbers = messages[0][order], messages[1][order]
    near = _nearest(times, stamps)
    apart = np.abs(stamps[near] - times)
    if apart.max() > JAW_NEAR * _step_ns(path, times):
        row = int(apart.argmax())
        raise MotionError(
            f"{path}: {jaw} has nothing within a step of row {row + 1} of {pose}, the nearest is "
            f"{1e-9 * apart[row]:.3g} s away; record both at one rate and by one clock"
        )
    angles: FloatArray = numbers[near, 0]
    return angles


def _common_times(path: Path, stamps: Mapping[str, Stamps]) -> FloatArray:
    """The rows' times, which all arms share, since the first, s, (n,)."""
    first, *rest = stamps
    base = stamps[first]
    for name in rest:
        if len(stamps[name]) != len(base):
            raise MotionError(
                f"{path}: {first} has {len(base)} poses and {name} {len(stamps[name])}; resample "
                "them so that a row is of one moment"
            )
        apart = np.abs(stamps[name] - base)
        if apart.max() > PAIRED * _step_ns(path, base):
            row = int(apart.argmax())
            raise MotionError(
                f"{path}: row {row + 1} of {name} is {1e-9 * apart[row]:.3g} s from that of "
                f"{first}; resample them so that a row is of one moment"
            )
    times: FloatArray = (base - base[0]) * 1e-9
    return times


def _step_ns(path: Path, times: Stamps) -> float:
    if len(times) == 1:
        return ONE_ROW_NS
    step = float(np.median(np.diff(times)))
    if step <= 0.0:
        raise MotionError(f"{path}: its times do not rise; put its messages in order")
    return step


def _nearest(times: Stamps, among: Stamps) -> npt.NDArray[np.intp]:
    """Index of the nearest of `among`, which rise, for each of `times`."""
    after = np.searchsorted(among, times).clip(0, len(among) - 1)
    before = (after - 1).clip(0)
    return np.where(times - among[before] <= np.abs(among[after] - times), before, after)


def _first(tracks: Mapping[str, Track], topics: Sequence[str]) -> str | None:
    return next((topic for topic in topics if topic in tracks), None)


def _arrays(track: Track) -> tuple[Stamps, FloatArray]:
    return np.array(track[0], dtype=np.int64), np.array(track[1])


def _numbers(message: Any) -> list[float]:
    """Position and quaternion of a PoseStamped, or the one position of a jaw's JointState."""
    if hasattr(message, "pose"):
        p, q = message.pose.position, message.pose.orientation
        return [p.x, p.y, p.z, q.x, q.y, q.z, q.w]
    return [float(message.position[0])]


def _label(path: Path) -> Label | None:
    """What a bag's MCAP file says, where there is one and it does."""
    files = [path] if path.suffix == ".mcap" else sorted(path.glob("*.mcap"))
    for name in files:
        file = RunFile(name)
        for _ in file.chunks():
            pass
        return label_of(file.metadata, path)
    return None
