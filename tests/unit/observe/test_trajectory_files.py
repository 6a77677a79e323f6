"""Trajectories come back from every file and frame as they were; mistakes in them are named."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import DataFileError, MotionError, RecordingError
from viskill_deploy.core.types import Waypoint
from viskill_deploy.motion.frames import CONTROL_POINTS, FRAMES, Label
from viskill_deploy.motion.resolve import resolve
from viskill_deploy.motion.trajectory import (
    ArmPath,
    Written,
    read_plan,
    waypoints_of,
    write_plan,
    written_of,
)
from viskill_deploy.motion.waypoints import start_waypoint
from viskill_deploy.observe.trajectory_files import (
    JointNames,
    read_written,
    write_joint_plan,
    write_written,
)
from viskill_deploy.runtime.trajectory import checked_waypoints, plan_waypoints
from viskill_deploy.sim.closed_loop import ClosedLoop
from viskill_deploy.sim.tasks.base import load_task

TASK = load_task("bipegtransfer")
CELL = TASK.cell
HOME = resolve(CELL, [start_waypoint(CELL)], [(0.0,) * 7] * 2)[1]
ENDINGS = (".csv", ".npz", "")


@pytest.fixture(scope="module")
def waypoints() -> list[Waypoint]:
    """The scripted grasp of BiPegTransfer, from where the arms start."""
    loop, rng = ClosedLoop(TASK), np.random.default_rng(2)
    seen = loop.reset(TASK.sample_layout(rng, "reference"))
    goal = TASK.subgoals(seen, loop.world.scene(), rng)["grasp"]
    found = [loop.waypoint]
    for _ in range(TASK.skills[0].budget):
        seen = loop.step(TASK.scripted_action("grasp", seen, goal), TASK.skills[0])
        found.append(loop.waypoint)
    return found


@pytest.fixture(scope="module")
def wished(waypoints: list[Waypoint]) -> np.ndarray:
    return plan_waypoints(CELL, waypoints, HOME).motion.table(0.05)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("point", CONTROL_POINTS)
@pytest.mark.parametrize("frame", FRAMES)
def test_every_file_and_frame_gives_the_same_joint_plan(
    tmp_path: Path,
    waypoints: list[Waypoint],
    wished: np.ndarray,
    frame: Any,
    point: Any,
    ending: str,
) -> None:
    label, path = Label(frame, point), tmp_path / f"mine{ending}"
    write_written(path, written_of(CELL, waypoints, label))
    written = read_written(path)
    assert written.label == label, "the file says what its numbers mean"
    back = checked_waypoints(CELL, written, label, None, str(path))
    write_plan(tmp_path / "mine.plan.json", CELL, back, "test")
    kept = read_plan(tmp_path / "mine.plan.json").unpacked()
    plan = plan_waypoints(CELL, kept, HOME).motion.table(0.05)
    assert plan.shape == wished.shape
    assert np.abs(plan[:, :, 0] - wished[:, :, 0]).max() < 1e-9


def mislabelled(waypoints: list[Waypoint], true: Label, said: Label) -> str:
    written = written_of(CELL, waypoints, true)
    with pytest.raises(MotionError) as caught:
        checked_waypoints(CELL, written, said, None, "mine.csv")
    return str(caught.value)


@pytest.mark.parametrize("frame", FRAMES)
def test_a_wrong_control_point_is_caught_with_a_hint(waypoints: list[Waypoint], frame: Any) -> None:
    for true, said in (CONTROL_POINTS, CONTROL_POINTS[::-1]):
        message = mislabelled(waypoints, Label(frame, true), Label(frame, said))
        assert f"about the {true} (10.2 mm)" in message


@pytest.mark.parametrize(
    ("true", "said", "hint"),
    [
        (Label("surrol", "jaw-pivot"), Label("world", "jaw-pivot"), "in frame surrol"),
        (Label("world", "jaw-pivot"), Label("surrol", "jaw-pivot"), "in frame world"),
        (Label("surrol", "jaw-pivot"), Label("surrol", "jaw-pivot", 1.0), "scaled by 5"),
        (Label("crtk", "jaw-end"), Label("crtk", "jaw-end", 5.0), "not scaled"),
        (Label("crtk", "jaw-pivot"), Label("rcm", "jaw-pivot"), "in frame crtk"),
        (Label("rcm", "jaw-pivot"), Label("task", "jaw-pivot"), "in frame rcm"),
    ],
    ids=str,
)
def test_a_wrong_frame_or_scale_is_caught_with_a_hint(
    waypoints: list[Waypoint], true: Label, said: Label, hint: str
) -> None:
    assert hint in mislabelled(waypoints, true, said)


def test_seven_millimetres_of_insertion_are_caught_with_a_hint(waypoints: list[Waypoint]) -> None:
    label = Label("crtk", "jaw-pivot")
    written = written_of(CELL, waypoints, label)
    arms = {}
    for name, path in written.arms.items():
        away = path.position / np.linalg.norm(path.position, axis=1, keepdims=True)
        arms[name] = ArmPath(path.position - 0.0071 * away, path.quaternion, path.jaw)
    with pytest.raises(MotionError, match=r"insertion is 7\.1 mm less"):
        checked_waypoints(CELL, Written(written.time_s, arms), label, None, "mine.csv")


def test_a_trajectory_that_starts_elsewhere_for_no_usual_reason_is_led_to(
    waypoints: list[Waypoint],
) -> None:
    label = Label("task", "jaw-pivot")
    later = waypoints[20:]
    assert len(checked_waypoints(CELL, written_of(CELL, later, label), label, None, "a")) == 26
    plan = plan_waypoints(CELL, later, HOME)
    assert np.abs(plan.motion.at(0.0)[0].p - HOME[0]).max() < 1e-9
    far = written_of(CELL, waypoints, label)
    path = far.arms["PSM1"]
    moved = {**far.arms, "PSM1": ArmPath(path.position + 10.0, path.quaternion, path.jaw)}
    with pytest.raises(MotionError, match="no usual mistake"):
        checked_waypoints(CELL, Written(None, moved), label, None, "a")


HEADER = "time_s," + ",".join(
    f"{a}.{c}" for a in ("PSM1", "PSM2") for c in ("x", "y", "z", "qx", "qy", "qz", "qw", "jaw")
)
ROW = "-0.05,0.05,0.05,1,0,0,0,0,-0.05,-0.05,0.05,1,0,0,0,0"
GOOD = f"{HEADER}\n0.0,{ROW}\n0.2,{ROW}\n"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "no rows"),
        (HEADER, "no rows"),
        (GOOD.replace("0.2,", "x,"), "line 3"),
        (GOOD.replace("0.2,", "0.2,7,"), "line 3: 18 numbers for 17 columns"),
        (GOOD.replace("PSM2.qw", "PSM2.q4"), r"PSM2\.qw"),
        (GOOD.replace("PSM2.qw", "PSM1.qw"), "twice"),
        (GOOD.replace("PSM1.", "PSM1,").replace("PSM2.", "PSM2."), "twice|lacks"),
        ("# frame: moon\n# control_point: jaw-pivot\n" + GOOD, "moon"),
        ("# frame: task\n" + GOOD, "says frame alone"),
        ("# length_scale: 5\n" + GOOD, "says length_scale alone"),
        ("# Control_Point: jaw-end\n" + GOOD, "says control_point alone"),
        ("# frame: task\n# control_point: jaw-pivot\n# length_scale: 0\n" + GOOD, "length_scale"),
        ("# frame: task\n# control_point: jaw-pivot\n# length_scale: big\n" + GOOD, "big"),
    ],
)
def test_a_csv_that_makes_no_sense_is_refused_with_its_line(
    tmp_path: Path, text: str, match: str
) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(MotionError, match=match):
        read_written(path)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda t: t.replace("PSM2.", "PSM3."), "needs PSM1, PSM2"),
        (lambda t: t.replace(",1,0,0,0,0,-0.05", ",2,0,0,0,0,-0.05"), "has not length 1"),
        (lambda t: t.replace("0.2,-0.05", "0.2,nan"), "not finite at waypoint 2"),
        (lambda t: t.replace("0.2,", "-0.2,"), "do not rise"),
        (lambda t: t + f"0.5,{ROW}\n", "0.2 to 0.3 s long"),
    ],
)
def test_a_trajectory_that_makes_no_sense_is_refused(
    tmp_path: Path, change: Callable[[str], str], match: str
) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(change(GOOD))
    with pytest.raises(MotionError, match=match):
        waypoints_of(CELL, read_written(path), Label("task", "jaw-pivot"), None, "bad.csv")


def test_angles_may_stand_in_place_of_quaternions_and_times_may_be_left_out(tmp_path: Path) -> None:
    path = tmp_path / "euler.csv"
    names = [f"{a}.{c}" for a in ("PSM1", "PSM2") for c in ("x", "y", "z", "roll", "pitch", "yaw")]
    row = "2.5,0.25,3.776,-1.5707963267948966,0,1.5707963267948966"
    other = row.replace("0.25", "-0.25")
    path.write_text(",".join([*names, "PSM1.jaw", "PSM2.jaw"]) + f"\n{row},{other},0.1,0.2\n")
    label = Label("surrol", "jaw-pivot")
    (waypoint,) = checked_waypoints(CELL, read_written(path), label, None, "euler.csv")
    for found, start in zip(waypoint.T_task_tip, start_waypoint(CELL).T_task_tip, strict=True):
        assert found == pytest.approx(start, abs=1e-9)
    assert waypoint.jaw == (0.1, 0.2)
    assert waypoint.step_s == 0.2
    (slow,) = checked_waypoints(CELL, read_written(path), label, 0.5, "euler.csv")
    assert slow.step_s == 0.5


@pytest.mark.parametrize("ending", [".csv", ".npz"])
def test_no_file_is_written_over_and_its_folder_is_made(
    tmp_path: Path, waypoints: list[Waypoint], ending: str
) -> None:
    path, label = tmp_path / "new" / f"mine{ending}", Label("task", "jaw-pivot")
    write_written(path, written_of(CELL, waypoints[:2], label))
    kept = path.read_bytes()
    names = [JointNames(arm.name, ("a", "b", "c", "d", "e", "f", "jaw")) for arm in CELL.arms]
    with pytest.raises(RecordingError, match="exists; name a new file"):
        write_written(path, written_of(CELL, waypoints[:3], label))
    with pytest.raises(RecordingError, match="exists; name a new file"):
        write_joint_plan(path, 0.01, np.zeros((3, 2, 2, 7)), names)
    assert path.read_bytes() == kept
    plan = tmp_path / "plans" / "mine.plan.json"
    write_plan(plan, CELL, waypoints[:2], "test")
    with pytest.raises(RecordingError, match="exists; name a new file"):
        write_plan(plan, CELL, waypoints[:2], "test")


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(MotionError, match="no such file"):
        read_written(tmp_path / "none.csv")
    (tmp_path / "a.txt").touch()
    with pytest.raises(MotionError, match=r"is no \.csv"):
        read_written(tmp_path / "a.txt")
    (tmp_path / "a.mcap").write_bytes(b"nothing")
    with pytest.raises(MotionError, match="as a bag"):
        read_written(tmp_path / "a.mcap")
    (tmp_path / "a.csv").write_bytes(b"\xff\xff")
    with pytest.raises(MotionError, match="as text"):
        read_written(tmp_path / "a.csv")
    with pytest.raises(MotionError, match=r"name a \.csv"):
        write_written(tmp_path / "a.txt", Written(None, {}))


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_bag_of_another_program_is_read(tmp_path: Path, storage: Any) -> None:
    """Written by rosbags: local poses, stamps of their own, jaws without velocities."""
    types = get_typestore(Stores.ROS2_HUMBLE).types
    store = get_typestore(Stores.ROS2_HUMBLE)

    def header(ns: int) -> Any:
        stamp = types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="")

    home = written_of(CELL, [start_waypoint(CELL)], Label("crtk", "jaw-pivot")).arms
    with Writer(tmp_path / "bag", version=9, storage_plugin=storage) as writer:
        for arm, path in home.items():
            pose = writer.add_connection(
                f"/{arm}/local/measured_cp", "geometry_msgs/msg/PoseStamped", typestore=store
            )
            jaw = writer.add_connection(
                f"/{arm}/jaw/measured_js", "sensor_msgs/msg/JointState", typestore=store
            )
            for i in range(3):
                ns = 1_700_000_000_000_000_000 + i * 100_000_000
                message = types["geometry_msgs/msg/PoseStamped"](
                    header(ns),
                    types["geometry_msgs/msg/Pose"](
                        types["geometry_msgs/msg/Point"](*path.position[0]),
                        types["geometry_msgs/msg/Quaternion"](*path.quaternion[0]),
                    ),
                )
                kind = "geometry_msgs/msg/PoseStamped"
                writer.write(pose, ns, store.serialize_cdr(message, kind))
                state = types["sensor_msgs/msg/JointState"](
                    header(ns + 1_000_000), ["jaw"], np.array([0.1 * i]), np.empty(0), np.empty(0)
                )
                kind = "sensor_msgs/msg/JointState"
                writer.write(jaw, ns + 1_000_000, store.serialize_cdr(state, kind))
    written = read_written(tmp_path / "bag")
    assert written.label is None
    found = checked_waypoints(CELL, written, Label("crtk", "jaw-pivot"), None, "bag")
    assert [w.jaw for w in found] == [(0.0, 0.0), (0.1, 0.1), (0.2, 0.2)]
    assert found[0].step_s == pytest.approx(0.1, abs=1e-12)
    assert found[0].T_task_tip[1] == pytest.approx(start_waypoint(CELL).T_task_tip[1], abs=1e-9)


def test_a_bag_without_a_jaw_or_in_place_of_another_is_refused(
    tmp_path: Path, waypoints: list[Waypoint]
) -> None:
    label = Label("task", "jaw-pivot")
    write_written(tmp_path / "bag", written_of(CELL, waypoints[:2], label))
    with pytest.raises(RecordingError, match="new folder"):
        write_written(tmp_path / "bag", written_of(CELL, waypoints[:2], label))
    names = [JointNames(arm.name, ("a", "b", "c", "d", "e", "f", "jaw")) for arm in CELL.arms]
    write_joint_plan(tmp_path / "joints", 0.01, np.zeros((3, 2, 2, 7)), names)
    with pytest.raises(MotionError, match="PSM1 needs a PoseStamped"):
        waypoints_of(CELL, read_written(tmp_path / "joints"), label, None, "bag")


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_joint_plan_is_written_as_it_is(
    tmp_path: Path, waypoints: list[Waypoint], ending: str
) -> None:
    table = np.ascontiguousarray(
        plan_waypoints(CELL, waypoints[:4], HOME).motion.table(0.01)[:, :, :2]
    )
    axes = (*(joint.name for joint in CELL.arms[0].arm.joints), "jaw")
    names = [JointNames(arm.name, axes) for arm in CELL.arms]
    path = tmp_path / f"joints{ending}"
    write_joint_plan(path, 0.01, table, names)
    if ending == ".csv":
        head, *rows = path.read_text().splitlines()
        assert head.startswith("time_s,PSM1.yaw,PSM1.pitch") and "PSM2.v_jaw" in head
        numbers = np.array([row.split(",") for row in rows], dtype=float)
        assert np.array_equal(numbers[:, 1:].reshape(table.shape), table)
        assert numbers[:2, 0] == pytest.approx([0.01, 0.02])
    elif ending == ".npz":
        content = np.load(path)
        assert np.array_equal(content["PSM2/position"], table[:, 1, 0])
        assert content["PSM1/axes"].tolist() == list(axes)
    else:
        from viskill_deploy.observe.reading import read_recording  # noqa: PLC0415

        tracks = read_recording(path).joints
        assert np.array_equal(tracks["/PSM1/servo_jp"].position, table[:, 0, 0, :6])
        assert np.array_equal(tracks["/PSM2/jaw/servo_jp"].velocity[:, 0], table[:, 1, 1, 6])
    with pytest.raises(MotionError, match=r"name a \.csv"):
        write_joint_plan(tmp_path / "a.txt", 0.01, table, names)


def test_a_plan_file_that_makes_no_sense_is_refused(
    tmp_path: Path, waypoints: list[Waypoint]
) -> None:
    path = tmp_path / "mine.plan.json"
    write_plan(path, CELL, waypoints[:2], "test")
    good = path.read_text()
    for old, new in (
        ('"schema": 2', '"schema": 1'),
        ('"step_s": 0.2', '"step_s": 0'),
        ('"quaternion_xyzw": [[', '"quaternion_xyzw": [[9'),
        ('"jaw_rad": [', '"jaw_rad": [0.0, '),
        (
            "}",
            "",
        ),
    ):
        path.write_text(good.replace(old, new, 1))
        with pytest.raises(DataFileError):
            read_plan(path)
    with pytest.raises(DataFileError, match="no plan file"):
        read_plan(tmp_path / "none.plan.json")


def test_another_cells_world_is_another() -> None:
    board = load_cell("bipegboard")
    label = Label("world", "jaw-pivot")
    here = written_of(CELL, [start_waypoint(CELL)], label).arms["PSM1"].position
    there = written_of(board, [start_waypoint(board)], label).arms["PSM1"].position
    assert here[0] == pytest.approx([0.5, 0.05, 0.7552])
    assert there[0] == pytest.approx(
        np.add(board.arms[0].entry.start_position_m, [0.55, 0.0, 0.690])
    )
