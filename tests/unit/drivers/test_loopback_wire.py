import json
import socket
from collections.abc import Iterator

import numpy as np
import pytest

from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import ActiveObject, ObjectPose, Scene
from viskill_deploy.drivers.loopback_wire import (
    LineSocket,
    pack_object,
    pack_scene,
    unpack_object,
    unpack_scene,
)


def moved(y: float) -> np.ndarray:
    pose = np.eye(4)
    pose[1, 3] = y
    return pose


@pytest.mark.parametrize("door_touched", [False, True])
def test_the_active_object_arrives_as_it_was_sent(door_touched: bool) -> None:
    thing = ActiveObject(moved(0.1 + 1e-17), 0.3, (True, False), door_touched)
    back = unpack_object(json.loads(json.dumps(pack_object(thing))))
    assert np.array_equal(back.T_task_object, thing.T_task_object)
    assert (back.speed_m_s, back.touched) == (0.3, (True, False))
    assert back.door_touched is door_touched


def test_letters_and_doors_arrive_as_they_were_sent() -> None:
    objects = (ObjectPose("letterB", moved(0.055)), ObjectPose("door2", moved(0.0751)))
    scene = Scene(1.25, objects, "letterB", np.array([0.025, -0.025, 0.0038]))
    back = unpack_scene(json.loads(json.dumps(pack_scene(scene))))
    assert [thing.name for thing in back.objects] == ["letterB", "door2"]
    assert np.array_equal(back.pose("door2"), moved(0.0751))
    assert (back.stamp_s, back.active) == (1.25, "letterB")
    assert np.array_equal(back.goal, scene.goal)


@pytest.fixture
def ends() -> Iterator[tuple[LineSocket, socket.socket]]:
    ours, theirs = socket.socketpair()
    line = LineSocket(ours)
    yield line, theirs
    line.close()
    theirs.close()


def test_the_last_words_of_one_who_has_gone_are_heard(ends) -> None:
    line, theirs = ends
    theirs.sendall(b'{"do":"hold"}\n{"do":"disable"}\n{"do":"hal')
    theirs.close()
    assert line.receive() == [{"do": "hold"}, {"do": "disable"}]
    with pytest.raises(DriverError, match="closed"):
        line.receive()


def test_one_who_goes_without_a_word_is_gone_at_once(ends) -> None:
    line, theirs = ends
    theirs.sendall(b"{")
    theirs.close()
    with pytest.raises(DriverError, match="closed"):
        line.receive()


class Reset:
    """A socket that gives some bytes and then breaks, as one whose other side was killed."""

    def __init__(self, *chunks: bytes) -> None:
        self.chunks = list(chunks)

    def setblocking(self, flag: bool) -> None:
        pass

    def recv(self, size: int) -> bytes:
        if not self.chunks:
            raise ConnectionResetError
        return self.chunks.pop(0)


def test_a_connection_that_breaks_gives_what_came_before() -> None:
    line = LineSocket(Reset(b'{"a":1}\n'))  # type: ignore[arg-type]
    assert line.receive() == [{"a": 1}]
    with pytest.raises(DriverError, match="gone"):
        line.receive()
