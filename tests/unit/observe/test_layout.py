from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from viskill_deploy.observe import layout, messages

HEAD = layout.RECORD_HEAD.size


@pytest.fixture(scope="module")
def store():
    made = get_typestore(Stores.ROS2_JAZZY)
    own = messages.VERDICT.definition.split("=" * 80)[0]
    made.register(get_types_from_msg(own, messages.VERDICT.name))
    return made


def header(store, frame: str, ns: int):
    stamp = store.types["builtin_interfaces/msg/Time"](ns // 10**9, ns % 10**9)
    return store.types["std_msgs/msg/Header"](stamp, frame)


def one(column: layout.Column, ns: int) -> np.ndarray:
    return column.records(np.array([ns + 5]), np.array([ns]))


def test_joint_states_have_the_bytes_of_a_general_serialiser(store):
    names, ns = ["yaw", "pitch", "wrist_yaw"], 1_700_000_000_123_456_789
    record = one(layout.joint_state(names).column(3), ns)
    record["position"], record["velocity"] = [0.1, -2.5, 3e-9], [1.0, np.inf, -0.0]
    expected = store.serialize_cdr(
        store.types["sensor_msgs/msg/JointState"](
            header(store, "", ns), names, np.array([0.1, -2.5, 3e-9]),
            np.array([1.0, np.inf, -0.0]), np.array([]),
        ),
        "sensor_msgs/msg/JointState",
    )  # fmt: skip
    assert record.tobytes()[HEAD:] == bytes(expected)


def test_poses_have_the_bytes_of_a_general_serialiser(store):
    types, ns = store.types, 99
    record = one(layout.pose_stamped("task").column(1), ns)
    record["position"], record["orientation"] = [1.0, 2.0, 3.0], [0.5, -0.5, 0.5, 0.5]
    pose = types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](1.0, 2.0, 3.0),
        types["geometry_msgs/msg/Quaternion"](0.5, -0.5, 0.5, 0.5),
    )
    message = types["geometry_msgs/msg/PoseStamped"](header(store, "task", ns), pose)
    expected = store.serialize_cdr(message, "geometry_msgs/msg/PoseStamped")
    assert record.tobytes()[HEAD:] == bytes(expected)


@pytest.mark.parametrize("mode", ["off", "armed", "running", "estopped"])
@pytest.mark.parametrize("rule", ["", "S05", "S10b"])
def test_verdicts_have_the_bytes_of_a_general_serialiser(store, rule, mode):
    record = one(layout.verdict(rule, mode).column(1), 7)
    record["action"], record["arm"], record["joint"] = 3, -1, 6
    record["value"], record["limit"] = 0.25, 0.2
    kind = messages.VERDICT.name
    message = store.types[kind](header(store, "", 7), 3, rule, -1, 6, 0.25, 0.2, mode)
    assert record.tobytes()[HEAD:] == bytes(store.serialize_cdr(message, kind))


def test_a_column_repeats_its_constant_bytes_in_every_record():
    column = layout.pose_stamped("task").column(9)
    times = np.array([10, 20, 30])
    records = column.records(times, times)
    opcode, size, channel, sequence, log, publish = layout.RECORD_HEAD.unpack_from(records[2:])
    assert (opcode, channel, sequence, log, publish) == (5, 9, 0, 30, 30)
    assert size == column.dtype.itemsize - 9
    whole = records.tobytes()
    assert whole.count(b"\x05\0\0\0task\0") == 3


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: sum(map(abs, q)) > 0.1))
def test_a_rotation_survives_the_way_through_its_quaternion(q):
    x, y, z, w = np.array(q) / np.linalg.norm(q)
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    found = layout.quaternions(R[None])[0]
    assert found[3] >= 0
    np.testing.assert_allclose(abs(found @ [x, y, z, w]), 1.0, atol=1e-12)
