"""Bags of a dVRK: which topics are read, which arms, and which rows belong together."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from viskill_deploy.core.errors import MotionError
from viskill_deploy.observe.trajectory_bags import read_bag

STORE = get_typestore(Stores.ROS2_HUMBLE)
STEP_NS = 10**8
STAMPS = 1_700_000_000_000_000_000 + STEP_NS * np.arange(4)
ARMS = ("PSM1", "PSM2")

Topics = dict[str, tuple[np.ndarray, np.ndarray]]


def poses(x: float, count: int = 4) -> np.ndarray:
    """At x, y = row; upright."""
    rows = np.zeros((count, 7))
    rows[:, 0], rows[:, 1], rows[:, 6] = x, np.arange(count), 1.0
    return rows


def jaws(count: int = 4) -> np.ndarray:
    return 0.1 * np.arange(count)[:, None]


def topics(kind: str = "measured_cp") -> Topics:
    found: Topics = {}
    for arm in ARMS:
        found[f"/{arm}/{kind}"] = (STAMPS, poses(1.0))
        found[f"/{arm}/jaw/measured_js"] = (STAMPS, jaws())
    return found


def bag(path: Path, topics: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Path:
    """A rosbag2 with a pose (7 numbers) or a jaw (1) a row."""
    types = STORE.types
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, (stamps, rows) in topics.items():
            is_pose = rows.shape[1] == 7
            kind = "geometry_msgs/msg/PoseStamped" if is_pose else "sensor_msgs/msg/JointState"
            connection = writer.add_connection(topic, kind, typestore=STORE)
            for ns, row in zip(stamps.tolist(), rows, strict=True):
                stamp = types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
                header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
                message: Any
                if is_pose:
                    place = types["geometry_msgs/msg/Point"](*row[:3])
                    turn = types["geometry_msgs/msg/Quaternion"](*row[3:])
                    pose = types["geometry_msgs/msg/Pose"](place, turn)
                    message = types[kind](header, pose)
                else:
                    message = types[kind](header, ["jaw"], row, np.empty(0), np.empty(0))
                writer.write(connection, ns, STORE.serialize_cdr(message, kind))
    return path


def test_arms_that_were_recorded_at_other_times_are_not_paired_by_row(tmp_path: Path) -> None:
    good = topics()
    late = {**good, "/PSM2/measured_cp": (STAMPS + 10 * STEP_NS, poses(1.0))}
    late["/PSM2/jaw/measured_js"] = (STAMPS + 10 * STEP_NS, jaws())
    with pytest.raises(MotionError, match="row 1 of PSM2 is 1 s from that of PSM1"):
        read_bag(bag(tmp_path / "late", late))
    drifts = {**good, "/PSM2/measured_cp": (STAMPS + np.array([0, 0, 0, STEP_NS // 2]), poses(1.0))}
    with pytest.raises(MotionError, match="row 4 of PSM2"):
        read_bag(bag(tmp_path / "drifts", drifts))
    short = {**good, "/PSM2/measured_cp": (STAMPS[:3], poses(1.0, 3))}
    with pytest.raises(MotionError, match="PSM1 has 4 poses and PSM2 3"):
        read_bag(bag(tmp_path / "short", short))
    jitters = {**good, "/PSM2/measured_cp": (STAMPS + np.array([0, 10**6, 0, 10**6]), poses(1.0))}
    written = read_bag(bag(tmp_path / "jitters", jitters))
    assert written.time_s == pytest.approx([0.0, 0.1, 0.2, 0.3])
    stands = {**good, "/PSM1/measured_cp": (np.full(4, STAMPS[0]), poses(1.0))}
    with pytest.raises(MotionError, match="do not rise"):
        read_bag(bag(tmp_path / "stands", stands))


def test_a_jaw_that_was_recorded_at_another_time_is_not_taken(tmp_path: Path) -> None:
    hour = 3600 * 10**9
    away = {**topics(), "/PSM2/jaw/measured_js": (STAMPS + hour, jaws())}
    with pytest.raises(MotionError, match=r"/PSM2/jaw/measured_js has nothing within a step"):
        read_bag(bag(tmp_path / "away", away))
    half_rate = {**topics(), "/PSM2/jaw/measured_js": (STAMPS[::2], jaws()[::2])}
    jaw = read_bag(bag(tmp_path / "half", half_rate)).arms["PSM2"].jaw
    assert jaw == pytest.approx([0.0, 0.0, 0.2, 0.2])


@pytest.mark.parametrize(
    ("frame", "x"), [("crtk", 2.0), ("rcm", 2.0), (None, 2.0), ("task", 1.0), ("world", 1.0)]
)
def test_poses_seen_from_the_remote_centre_are_those_below_local(
    tmp_path: Path, frame: Any, x: float
) -> None:
    both = topics("setpoint_cp")
    for arm in ARMS:
        both[f"/{arm}/local/measured_cp"] = (STAMPS, poses(2.0))
    written = read_bag(bag(tmp_path / "bag", both), frame=frame)
    assert written.arms["PSM1"].position[:, 0] == pytest.approx(x)
    name = "local/measured_cp" if x == 2.0 else "setpoint_cp"
    assert f"PSM1: poses of /PSM1/{name}, jaw of /PSM1/jaw/measured_js" in written.notes


def test_poses_of_any_frame_that_are_said_to_be_of_the_remote_centre_are_asked_about(
    tmp_path: Path,
) -> None:
    path = bag(tmp_path / "bag", topics())
    assert "PSM1: has nothing below local/" in "\n".join(read_bag(path, frame="crtk").notes)
    assert "below local/" not in "\n".join(read_bag(path, frame="task").notes)


def test_poses_below_local_are_in_no_other_frame(tmp_path: Path) -> None:
    path = bag(tmp_path / "bag", topics("local/measured_cp"))
    with pytest.raises(MotionError, match="PSM1 needs a PoseStamped"):
        read_bag(path, frame="task")


def test_other_arms_of_a_bag_are_left_out(tmp_path: Path) -> None:
    whole = topics("local/measured_cp")
    whole["/ECM/local/measured_cp"] = (STAMPS[:2], poses(3.0, 2))
    whole["/MTML/measured_cp"] = (STAMPS[:2], poses(3.0, 2))
    path = bag(tmp_path / "bag", whole)
    written = read_bag(path, ARMS, "crtk")
    assert sorted(written.arms) == list(ARMS)
    assert "left out, no arms of this cell: ECM, MTML" in written.notes
    with pytest.raises(MotionError, match="ECM needs"):
        read_bag(path)
