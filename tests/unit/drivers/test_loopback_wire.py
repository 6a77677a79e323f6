import json

import numpy as np
import pytest

from viskill_deploy.core.types import ActiveObject, ObjectPose, Scene
from viskill_deploy.drivers.loopback_wire import (
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
