from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import synthetic_run as synthetic
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import RecordingError
from viskill_deploy.core.types import (
    Action,
    Boundary,
    GraspTest,
    Mode,
    Request,
    SkillStart,
    Verdict,
)
from viskill_deploy.observe import figures, messages
from viskill_deploy.observe.boundaries import boundary_of
from viskill_deploy.observe.reading import read_recording
from viskill_deploy.observe.recording import Recorder

CYCLES = 200


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "bag"
    synthetic.record(path, cycles=CYCLES)
    return path


@pytest.fixture(scope="module")
def by_topic(bag: Path) -> dict[str, list]:
    """Every message, decoded by rosbags."""
    store = get_typestore(Stores.ROS2_JAZZY)
    own = messages.VERDICT.definition.split("=" * 80)[0]
    store.register(get_types_from_msg(own, messages.VERDICT.name))
    found: dict[str, list] = {}
    with Reader(bag) as reader:
        for connection, log_ns, data in reader.messages():
            message = store.deserialize_cdr(data, connection.msgtype)
            found.setdefault(connection.topic, []).append((log_ns, message))
    return found


@pytest.fixture(scope="module")
def cycles() -> list[synthetic.Cycle]:
    cell = load_cell("bipegtransfer")
    return [synthetic.cycle(cell, index) for index in range(CYCLES)]


def stamp_ns(message: object) -> int:
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def test_rosbags_reads_every_joint_value_to_the_last_bit(by_topic, cycles):
    for arm, name in enumerate(("PSM1", "PSM2")):
        measured = [m for _, m in by_topic[f"/{name}/measured_js"]]
        sent = [m for _, m in by_topic[f"/{name}/setpoint_js"]]
        jaw = [m for _, m in by_topic[f"/{name}/jaw/setpoint_js"]]
        assert len(measured) == len(sent) == len(jaw) == CYCLES
        for c, m, s, j in zip(cycles, measured, sent, jaw, strict=True):
            assert m.name == list(c.state.arms[arm].joint_names)
            assert tuple(m.position) == c.state.arms[arm].measured_jp
            assert tuple(m.velocity) == c.state.arms[arm].measured_jv
            assert tuple(s.position) == c.sent[arm].jp
            assert tuple(s.velocity) == c.sent[arm].jv
            assert (j.name, j.position[0], j.velocity[0]) == (
                ["jaw"], c.sent[arm].jaw, c.sent[arm].jaw_v,
            )  # fmt: skip


def test_what_was_asked_is_recorded_only_where_something_was_asked(by_topic, cycles):
    asked = [c for c in cycles if c.request.setpoints is not None]
    recorded = [m for _, m in by_topic["/PSM2/requested_js"]]
    assert [tuple(m.position) for m in recorded] == [c.request.setpoints[1].jp for c in asked]
    failures = [m.data for _, m in by_topic["/request/failure"]]
    assert failures[:2] == ["no solution", ""]


def test_stamps_follow_the_drivers_clock_and_show_todays_date(by_topic, cycles):
    logs = [log for log, _ in by_topic["/PSM1/measured_js"]]
    assert abs(logs[0] * 1e-9 - time.time()) < 600
    np.testing.assert_allclose(np.diff(logs), synthetic.PERIOD_S * 1e9, atol=1)
    stamps = [stamp_ns(m) for _, m in by_topic["/PSM1/measured_js"]]
    np.testing.assert_allclose(np.array(logs) - stamps, 1e6, atol=1)  # measured 1 ms earlier


def test_tip_poses_come_back_as_position_and_unit_quaternion(by_topic, cycles):
    for c, (_, m) in zip(cycles, by_topic["/PSM1/measured_cp"], strict=True):
        T, p, q = c.tip_poses[0], m.pose.position, m.pose.orientation
        assert (p.x, p.y, p.z) == tuple(T[:3, 3])
        assert m.header.frame_id == "task"
        angle = np.arctan2(T[1, 0], T[0, 0])
        assert abs(abs(q.w) - abs(np.cos(angle / 2))) < 1e-12
        assert abs(q.x) + abs(q.y) < 1e-12
        assert np.sign(q.z * q.w) == np.sign(np.tan(angle / 2))


def test_every_cycle_leaves_a_verdict_and_a_rule_that_spoke_is_named(by_topic):
    verdicts = [m for _, m in by_topic["/safety/verdict"]]
    assert len(verdicts) == CYCLES
    spoke = {i: v for i, v in enumerate(verdicts) if v.rule}
    assert list(spoke) == [50, 150]
    v = spoke[50]
    assert (v.rule, v.action, v.arm, v.joint) == ("S05", Action.SCALE, 1, 2)
    assert (v.value, v.limit, v.mode) == (0.21, 0.2, "running")
    assert (verdicts[0].arm, verdicts[0].joint, verdicts[0].action) == (-1, -1, Action.PASS)


def test_the_scene_is_recorded_at_fifty_hertz(by_topic):
    times = np.array([log for log, _ in by_topic["/scene/block0"]]) * 1e-9
    assert len(times) == 40
    assert np.diff(times).min() > 0.0199
    assert by_topic["/scene/goal"][0][1].pose.position.y == 0.02


def test_mcap_ros2_reads_the_same_file(bag):
    reader = pytest.importorskip("mcap_ros2.reader")
    count = 0
    for message in reader.read_ros2_messages(str(next(bag.glob("*.mcap")))):
        count += 1
        if message.channel.topic == "/safety/verdict" and message.ros_msg.rule:
            assert message.ros_msg.limit == 0.2
    with Reader(bag) as expected:
        assert count == expected.message_count


def test_type_hashes_are_those_of_the_definitions():
    for kind in messages.TYPES:
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(kind.definition, kind.name))
        assert store.hash_rihs01(kind.name) == kind.rihs01


def test_our_own_reader_agrees_with_rosbags(bag, by_topic):
    data = read_recording(bag)
    assert data.complete
    for topic, track in data.joints.items():
        expected = np.array([m.position for _, m in by_topic[topic]])
        np.testing.assert_array_equal(track.position, expected)
        logs = np.array([log for log, _ in by_topic[topic]])
        np.testing.assert_allclose(track.time_s, (logs - data.origin_ns) * 1e-9, atol=1e-12)
    goal = data.poses["/scene/goal"]
    assert goal.position[0].tolist() == [0.01, 0.02, 0.0]
    assert [v.rule for v in data.verdicts if v.rule] == ["S05", "S05"]
    assert [(m.skill, m.step) for m in data.marks] == [("reach", 0), ("lift", 1)]
    assert data.about["arms"] == ["PSM1", "PSM2"]


def test_one_episode_of_many_is_read_alone(tmp_path):
    synthetic.record(tmp_path / "bag", episodes=3, cycles=120)
    data = read_recording(tmp_path / "bag", episode=1)
    track = data.joints["/PSM1/measured_js"]
    cell = load_cell("bipegtransfer")
    assert len(track.time_s) == 120
    assert tuple(track.position[0]) == synthetic.cycle(cell, 120).state.arms[0].measured_jp
    assert {mark.episode for mark in data.marks} == {1}
    with pytest.raises(RecordingError, match=r"no episode 7; ask for one of \[0, 1, 2\]"):
        read_recording(tmp_path / "bag", episode=7)


def test_a_killed_runtime_leaves_a_complete_bag(tmp_path):
    bag = tmp_path / "bag"
    script = (
        "import os, signal, sys; from pathlib import Path\n"
        f"sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        "import synthetic_run as synthetic\n"
        "from viskill_deploy.core.description import load_cell\n"
        "from viskill_deploy.observe.recording import Recorder\n"
        "cell = load_cell('bipegtransfer')\n"
        "recorder = Recorder(Path(sys.argv[1]), cell, 0.004, patience_s=30.0)\n"
        "synthetic.feed(recorder, cell, range(500))\n"
        "print(recorder._process.pid, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", script, str(bag)], stdout=subprocess.PIPE, check=False, timeout=60
    )
    assert run.returncode == -signal.SIGKILL
    wait_for_end(int(run.stdout))
    data = read_recording(bag)
    assert data.complete
    assert len(data.joints["/PSM2/measured_js"].time_s) == 500
    with Reader(bag) as reader:
        assert reader.message_count > 500 * 14


def wait_for_end(pid: int) -> None:
    """Waits for a process that is not our child: its descriptor reads as ready when it ends."""
    import select  # noqa: PLC0415

    try:
        descriptor = os.pidfd_open(pid)
    except ProcessLookupError:
        return
    assert select.select([descriptor], [], [], 30)[0], "the recorder does not end"
    os.close(descriptor)


def test_a_killed_recorder_is_noticed_and_never_raises_in_the_loop(tmp_path):
    cell = load_cell("bipegtransfer")
    recorder = Recorder(tmp_path / "bag", cell, 0.004)
    synthetic.feed(recorder, cell, range(10))
    assert recorder.alive
    recorder._process.kill()
    recorder._process.wait()
    synthetic.feed(recorder, cell, range(10, 20))
    assert not recorder.alive
    with pytest.raises(RecordingError, match="free disk space"):
        recorder.close()


def test_a_recorder_that_hangs_counts_as_dead_after_the_patience(tmp_path):
    cell = load_cell("bipegtransfer")
    recorder = Recorder(tmp_path / "bag", cell, 0.004, patience_s=0.01)
    synthetic.feed(recorder, cell, range(1))
    os.kill(recorder._process.pid, signal.SIGSTOP)
    for start in range(0, 5000, 100):
        synthetic.feed(recorder, cell, range(start, start + 100))
        if not recorder.alive:
            break
    assert not recorder.alive
    os.kill(recorder._process.pid, signal.SIGCONT)
    with pytest.raises(RecordingError):
        recorder.close()


def test_a_cut_off_file_gives_all_that_was_written_before(tmp_path):
    bag = tmp_path / "bag"
    synthetic.record(bag, cycles=3000)  # more than one chunk
    file = next(bag.glob("*.mcap"))
    whole = read_recording(bag)
    content = file.read_bytes()
    file.write_bytes(content[: len(content) * 6 // 10])
    part = read_recording(bag)
    assert not part.complete
    track = part.joints["/PSM1/measured_js"]
    count = len(track.time_s)
    assert 500 < count < 3000
    expected = whole.joints["/PSM1/measured_js"].position[:count]
    np.testing.assert_array_equal(track.position, expected)


def test_faulty_values_are_recorded_as_they_came(tmp_path):
    cell = load_cell("bipegtransfer")
    c = synthetic.cycle(cell, 1)
    first, second = c.state.arms
    faulty = replace(first, measured_jp=(float("nan"),) * 6, stamp_s=float("nan"))
    short = replace(second, measured_jp=(1.0, 2.0))
    state = replace(c.state, arms=(faulty, short))
    verdicts = (Verdict("S02", Action.FAULT, 0), Verdict("S23", Action.ESTOP))
    with Recorder(tmp_path / "bag", cell, 0.004) as recorder:
        recorder.cycle(1.0, state, Request(None), (), Action.ESTOP, verdicts, Mode.FAULT, None)
        assert recorder.alive
    data = read_recording(tmp_path / "bag")
    assert np.isnan(data.joints["/PSM1/measured_js"].position).all()
    assert data.joints["/PSM2/measured_js"].position[0, :2].tolist() == [1.0, 2.0]
    assert tuple(data.joints["/PSM1/setpoint_js"].position[0]) == first.setpoint_jp
    assert [(v.rule, v.mode) for v in data.verdicts] == [("S02", "fault"), ("S23", "fault")]
    assert "/PSM1/measured_cp" not in data.poses


def test_an_existing_folder_is_not_written_over(tmp_path):
    with pytest.raises(RecordingError, match="name a new folder"):
        Recorder(tmp_path, load_cell("bipegtransfer"), 0.004)


def test_a_run_without_a_cycle_still_makes_a_readable_bag(tmp_path):
    Recorder(tmp_path / "bag", load_cell("bipegtransfer"), 0.004).close()
    with Reader(tmp_path / "bag") as reader:
        assert reader.message_count == 0
    assert read_recording(tmp_path / "bag").duration_s == 0


def test_no_recording_is_refused_with_a_reason(tmp_path):
    with pytest.raises(RecordingError, match=r"holds no \.mcap file"):
        read_recording(tmp_path)
    (tmp_path / "x.mcap").write_bytes(b"nothing")
    with pytest.raises(RecordingError, match="not an MCAP file"):
        read_recording(tmp_path)


def test_a_damaged_chunk_is_refused_not_shown(tmp_path):
    synthetic.record(tmp_path / "bag", cycles=300)
    file = next((tmp_path / "bag").glob("*.mcap"))
    content = bytearray(file.read_bytes())
    at = content.index(b"\x28\xb5\x2f\xfd") + 2000  # inside the first compressed block
    content[at] ^= 0xFF
    file.write_bytes(content)
    with pytest.raises(RecordingError, match="damaged"):
        read_recording(tmp_path / "bag")


def test_what_was_decided_at_a_skills_start_is_recorded_with_its_first_step(tmp_path):
    cell = load_cell("bipegtransfer")
    subgoal = np.array([0.01, -0.02, 0.05, 0.0, 0.03, 0.04, 0.0, 1.0])
    with Recorder(tmp_path / "bag", cell, synthetic.PERIOD_S, patience_s=30.0) as recorder:
        synthetic.feed(recorder, cell, range(10))
        for step, start in enumerate([SkillStart("lift", subgoal, "chaining", 0.75), None]):
            recorder.mark(5.1 + step, 0, "lift", step, start=start)
        recorder.mark(8.0, 0, "place", 0, start=SkillStart("place", subgoal, "task"))
    data = read_recording(tmp_path / "bag", 0)
    reach, lift, next_step, place = data.marks
    assert (reach.subgoal, reach.subgoal_source, reach.value) == ((), "", None)
    assert (lift.subgoal, lift.subgoal_source, lift.value) == (tuple(subgoal), "chaining", 0.75)
    assert (next_step.subgoal, next_step.step) == ((), 1)
    assert (place.subgoal_source, place.value) == ("task", None)
    drawn = figures.path_figure(data, cell)["data"][-1]
    assert drawn["name"] == "subgoals"
    assert drawn["x"] == [10.0, 0.0] * 2
    assert drawn["text"] == ["lift, subgoal"] * 2 + ["place, subgoal"] * 2


def test_what_was_decided_between_two_skills_is_recorded(tmp_path):
    cell = load_cell("bipegtransfer")
    grasps = (GraspTest("PSM2", 0.01, -0.001, 0.07, True),)
    told = Boundary("lift", "place", grasps, 0.9, 0.5, "retry", "lift")
    with Recorder(tmp_path / "bag", cell, synthetic.PERIOD_S, patience_s=30.0) as recorder:
        synthetic.feed(recorder, cell, range(10))
        recorder.mark(5.1, 0, told.skill, 0, boundary=told)
    reach, boundary = read_recording(tmp_path / "bag", 0).marks
    assert reach.boundary is None
    assert boundary.skill == "lift"
    assert boundary.boundary is not None
    assert boundary_of(boundary.boundary) == told
