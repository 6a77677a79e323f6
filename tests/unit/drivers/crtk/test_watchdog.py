"""What the watchdog of arms over CRTK says to them, on a fake clock."""

from collections import Counter

import pytest
from scripted_arms import Room

from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.crtk.inproc import Inproc
from viskill_deploy.drivers.crtk.watchdog import CrtkStopper

LOOK_S = 0.004


@pytest.fixture
def room() -> Room:
    return Room()


def stopper(room: Room) -> CrtkStopper:
    made = CrtkStopper(["PSM1", "PSM2"], Inproc(room.exchange), room.clock)
    made.find()
    return made


def test_a_watchdog_that_watches_says_nothing(room: Room):
    made = stopper(room)
    for _ in range(100):
        made.check()
        room.clock.sleep_until(room.clock.now() + LOOK_S)
    assert [(arm.words, arm.holds, arm.sent) for arm in room.arms] == [([], [], [])] * 2


def test_arms_are_held_at_once_and_paused_at_the_next_look(room: Room):
    for arm in room.arms:
        arm.become("ENABLED", is_homed=True)
    made, began = stopper(room), room.clock.now()
    made.hold()
    assert [(arm.holds, arm.words) for arm in room.arms] == [([began], [])] * 2
    room.clock.sleep_until(began + LOOK_S)
    made.hold()
    assert [arm.state for arm in room.arms] == ["PAUSED", "PAUSED"]


def test_words_without_effect_are_said_again_and_those_with_one_are_not(room: Room):
    for arm in room.arms:
        arm.become("ENABLED", is_homed=True)
    room.arms[1].is_obedient = False
    made = stopper(room)
    for _ in range(50):
        made.hold()
        room.clock.sleep_until(room.clock.now() + LOOK_S)
    assert room.arms[0].words == ["pause"]
    assert 8 <= room.arms[1].words.count("pause") <= 11
    for _ in range(50):
        made.disable()
        room.clock.sleep_until(room.clock.now() + LOOK_S)
    assert Counter(room.arms[0].words) == {"pause": 1, "disable": 1}
    assert 8 <= room.arms[1].words.count("disable") <= 11
    assert set(room.arms[1].words) == {"pause", "disable"}
    assert room.arms[0].sent == room.arms[1].sent == []


def test_a_watchdog_that_finds_no_arm_or_loses_one_says_which(room: Room):
    made = stopper(room)
    room.arms[1].node.close()
    room.clock.peers = room.arms[:1]
    room.clock.sleep_until(room.clock.now() + 0.05)
    with pytest.raises(DriverError, match="lost /PSM2/hold"):
        made.check()
    late = CrtkStopper(["PSM1", "PSM2"], Inproc(room.exchange), room.clock)
    with pytest.raises(DriverError, match="nobody on /PSM2/hold"):
        late.find()


def test_one_arm_that_cannot_be_told_does_not_keep_the_other_from_being_held(room: Room):
    made = stopper(room)
    made._arms[0]._hold = lambda word: (_ for _ in ()).throw(DriverError("the line is cut"))
    made.hold()
    assert [len(arm.holds) for arm in room.arms] == [0, 1]
