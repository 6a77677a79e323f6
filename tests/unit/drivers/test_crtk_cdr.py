"""The bytes of ROS 2's messages, against figures of other programs and against two of them live."""

import json
from pathlib import Path
from typing import Any

import crtk_samples
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.msg import get_types_from_msg

from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.crtk.cdr import decoder, encoder
from viskill_deploy.drivers.crtk.conversion import from_native, to_native
from viskill_deploy.drivers.crtk.dds_types import DUMMY, dds_type
from viskill_deploy.drivers.crtk.messages import (
    Empty,
    Header,
    JointState,
    Point,
    Pose,
    Quaternion,
    String,
    Time,
    fields_of,
)

VECTORS = json.loads((Path(__file__).parents[2] / "golden/crtk_cdr.json").read_text())
EVERY = sorted(crtk_samples.MESSAGES.values(), key=lambda kind: kind.ROS)

CRTK = {
    "crtk_msgs/msg/OperatingState": "std_msgs/Header header\nstring state\nbool is_homed\n"
    "bool is_busy",
    "crtk_msgs/msg/StringStamped": "std_msgs/Header header\nstring string",
}


def of_vector(kind: type[Any], value: dict[str, Any]) -> Any:
    """The message that a vector means."""
    value = dict(value)
    if "orientation_xyzw" in value:
        place, turn = value.pop("position"), value.pop("orientation_xyzw")
        value["pose"] = Pose(Point(*place), Quaternion(*turn))
    if "header" in value:
        value["header"] = Header(Time(*value["header"]["stamp"]), value["header"]["frame_id"])
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in value.items()})


@pytest.mark.parametrize("vector", VECTORS, ids=lambda vector: vector["type"])
def test_the_bytes_are_those_of_three_other_programs(vector: dict[str, Any]) -> None:
    kind = crtk_samples.MESSAGES[vector["type"]]
    word = of_vector(kind, vector["value"])
    assert encoder(kind)(word).hex() == vector["bytes"]
    assert decoder(kind)(bytes.fromhex(vector["bytes"])) == word


@pytest.mark.parametrize("kind", EVERY, ids=lambda kind: kind.ROS)
def test_every_message_has_the_bytes_that_cyclonedds_gives_its_type(kind: type[Any]) -> None:
    def native(message: type[Any]) -> Any:
        struct = dds_type(message)
        return struct if fields_of(message) else lambda: struct(**{DUMMY: 0})

    for seed in range(20):
        word = crtk_samples.sample(kind, seed)
        its = to_native(kind, native)(word)
        assert its.serialize(use_version_2=False) == encoder(kind)(word)
        assert from_native(kind)(its) == word


@pytest.mark.parametrize("kind", EVERY, ids=lambda kind: kind.ROS)
def test_every_message_has_the_bytes_of_the_ros_definitions(kind: type[Any]) -> None:
    """The definitions that rosbags has of ROS 2 Jazzy: a field too many or misplaced shows."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in CRTK.items():
        store.register(get_types_from_msg(text, name))

    def name_of(message: type[Any]) -> str:
        return str(message.ROS).replace("/", "/msg/")

    for seed in range(20):
        data = encoder(kind)(crtk_samples.sample(kind, seed))
        assert (
            store.serialize_cdr(store.deserialize_cdr(data, name_of(kind)), name_of(kind)) == data
        )


def test_a_message_without_fields_is_one_byte() -> None:
    assert encoder(Empty)(Empty()).hex() == "0001000000"
    assert decoder(Empty)(bytes.fromhex("0001000000")) == Empty()


def test_the_other_byte_order_is_read_too() -> None:
    assert decoder(String)(bytes.fromhex("0000000000000003616200")) == String("ab")


@pytest.mark.parametrize("kind", EVERY, ids=lambda kind: kind.ROS)
def test_bytes_that_are_cut_short_are_refused_or_read_as_what_is_there(kind: type[Any]) -> None:
    data = encoder(kind)(crtk_samples.sample(kind, 1))
    for length in range(len(data)):
        try:
            word = decoder(kind)(data[:length])
        except DriverError:
            continue
        assert kind is Empty
        assert word == Empty()


def test_a_form_other_than_plain_cdr_is_refused() -> None:
    with pytest.raises(DriverError, match="another form"):
        decoder(String)(bytes.fromhex("0007000003000000616200"))


def test_a_text_that_is_no_utf8_is_read_with_a_mark() -> None:
    assert decoder(String)(bytes.fromhex("0001000003000000c33100")) == String("�1")


def test_a_count_that_no_message_can_hold_is_refused() -> None:
    data = encoder(JointState)(JointState())
    with pytest.raises(DriverError, match="cut short"):
        decoder(JointState)(data[:-4] + b"\xff\xff\xff\xff")


@given(st.binary(max_size=120))
def test_any_bytes_are_read_or_refused(data: bytes) -> None:
    try:
        word = decoder(JointState)(b"\x00\x01\x00\x00" + data)
    except DriverError:
        return
    assert isinstance(word, JointState)
