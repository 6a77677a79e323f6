"""Things that a tracker sees, and things that a jaw hides from it."""

from __future__ import annotations

import numpy as np
import pytest

from viskill_deploy.core.errors import DriverError
from viskill_deploy.core.types import ObjectPose, Scene
from viskill_deploy.runtime.poses import FILED, SURE_M, PoseLimits, Sighting, Things

LIMITS = PoseLimits(age_s=0.5, held_age_s=2.0, sigma_m=0.003)
FREE, HELD = (False, False), (True, False)


def at(x: float, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


class Seen:
    def __init__(self) -> None:
        self.newest_sighting: Sighting | None = None
        self.is_closed = False

    def see(self, x: float, now: float, sigma_m: float = 0.001) -> None:
        self.newest_sighting = Sighting(at(x), now, sigma_m)

    def newest(self, name: str) -> Sighting | None:
        return self.newest_sighting

    def close(self) -> None:
        self.is_closed = True


def things() -> tuple[Things, Seen]:
    source = Seen()
    scene = Scene(0.0, (ObjectPose("block", np.eye(4)),), "block", np.zeros(3))
    return Things(scene, source, LIMITS, ["PSM1", "PSM2"]), source


TIPS = [at(0.01), at(0.5)]


def test_a_thing_is_where_it_was_seen_last() -> None:
    known, source = things()
    source.see(0.1, 1.0)
    known.follow(1.0, TIPS, FREE)
    source.see(0.2, 1.1)
    assert known.scene(1.2).pose("block")[0, 3] == 0.2
    assert known.scene(1.2).stamp_s == 1.2


def test_a_thing_that_was_never_seen_is_nowhere() -> None:
    known, _ = things()
    with pytest.raises(DriverError, match="block was never seen"):
        known.scene(0.0)


def test_a_look_that_is_too_uncertain_or_older_than_the_last_is_none() -> None:
    known, source = things()
    source.see(0.1, 1.0, sigma_m=0.0031)
    with pytest.raises(DriverError, match="never seen within 3 mm"):
        known.scene(1.0)
    source.see(0.1, 1.0, sigma_m=float("nan"))
    with pytest.raises(DriverError, match="never seen"):
        known.scene(1.0)
    source.see(0.1, 1.0)
    known.scene(1.0)
    source.see(0.3, 0.9)
    assert known.scene(1.0).pose("block")[0, 3] == 0.1


def test_seen_is_what_was_looked_at_lately_and_well() -> None:
    known, source = things()
    source.see(0.1, 1.0, sigma_m=SURE_M)
    assert known.seen(1.5).pose("block")[0, 3] == 0.1
    known.follow(1.5, [at(0.1), at(0.5)], HELD)
    assert known.scene(1.6).objects, "it is in the jaw"
    assert not known.seen(1.6).objects, "and hidden there"
    source.see(0.1, 1.7, sigma_m=1.01 * SURE_M)
    assert known.scene(1.7).objects
    assert not known.seen(1.7).objects, "known, but not well"


def test_nobody_looks_at_the_things_of_a_scene_file() -> None:
    source = Seen()
    source.see(0.1, 0.0, sigma_m=0.0)
    scene = Scene(0.0, (ObjectPose("block", np.eye(4)),), "block", np.zeros(3))
    known = Things(scene, source, FILED, ["PSM1", "PSM2"])
    assert known.scene(0.0).objects
    assert not known.seen(0.0).objects


def test_a_thing_that_nobody_holds_is_nowhere_past_its_age() -> None:
    known, source = things()
    source.see(0.1, 1.0)
    known.follow(1.5, TIPS, FREE)
    with pytest.raises(DriverError, match=r"block was not seen for 0\.51 s \(limit 0\.5 s\)"):
        known.follow(1.51, TIPS, FREE)
    with pytest.raises(DriverError, match="look at the tracker and its clock"):
        known.scene(1.51)


def test_a_hidden_thing_in_a_jaw_goes_with_it_and_is_noted_once_and_only_for_so_long() -> None:
    known, source = things()
    source.see(0.02, 1.0)
    known.follow(1.0, TIPS, HELD)
    for now in (1.2, 1.6, 2.9):
        known.follow(now, [at(0.01, 0.0, now), TIPS[1]], HELD)
        np.testing.assert_allclose(known.scene(now).pose("block")[:3, 3], [0.02, 0.0, now])
    assert known.notes == ["block was not seen in PSM1's jaw from 1.6 s on: it was taken to move "
                           "with it"]  # fmt: skip
    with pytest.raises(DriverError, match=r"not seen for 2\.01 s \(limit 2 s\)"):
        known.follow(3.01, TIPS, HELD)


def test_a_look_at_a_thing_in_a_jaw_counts_more_than_reckoning() -> None:
    known, source = things()
    source.see(0.02, 1.0)
    known.follow(1.0, TIPS, HELD)
    source.see(0.025, 1.1)  # it slipped
    known.follow(1.1, TIPS, HELD)
    known.follow(1.2, [at(0.01, 0.1), TIPS[1]], HELD)
    np.testing.assert_allclose(known.scene(1.2).pose("block")[:3, 3], [0.025, 0.1, 0.0])


def test_a_closed_jaw_far_from_a_thing_does_not_take_it_along() -> None:
    known, source = things()
    source.see(0.1, 1.0)
    known.follow(1.0, TIPS, HELD)
    known.follow(1.1, [at(0.4), TIPS[1]], HELD)
    assert known.scene(1.1).pose("block")[0, 3] == 0.1


def test_what_is_handed_over_goes_with_the_second_jaw_once_the_first_lets_go() -> None:
    known, source = things()
    source.see(0.02, 1.0)
    near = [at(0.01), at(0.03)]
    known.follow(1.0, near, HELD)
    known.follow(1.1, near, (True, True))
    known.follow(1.2, [at(0.01), at(0.03)], (False, True))
    known.follow(1.3, [at(0.5), at(0.03, 0.2)], (False, True))
    np.testing.assert_allclose(known.scene(1.3).pose("block")[:3, 3], [0.02, 0.2, 0.0])


def test_a_thing_that_was_let_go_of_and_is_hidden_still_is_nowhere() -> None:
    known, source = things()
    source.see(0.02, 1.0)
    known.follow(1.0, TIPS, HELD)
    known.follow(2.0, TIPS, HELD)
    with pytest.raises(DriverError, match=r"limit 0\.5 s"):
        known.follow(2.1, TIPS, FREE)


def test_who_keeps_up_with_things_ends_the_looking() -> None:
    known, source = things()
    known.close()
    assert source.is_closed
