"""Tips come from topics, with the time at which they were seen."""

import numpy as np
import pytest

from viskill_deploy.calibrate.topic_tips import TopicTips, topics_of
from viskill_deploy.core.clock import SteppedClock
from viskill_deploy.core.description import load_cell
from viskill_deploy.core.errors import CalibrationError
from viskill_deploy.drivers.crtk.inproc import Exchange, Inproc
from viskill_deploy.drivers.crtk.messages import Header, Point, Pose, PoseStamped, Time
from viskill_deploy.drivers.crtk.simulated_cell import CrtkCell, ServerOptions
from viskill_deploy.drivers.crtk.tips_on_wire import tip_topic
from viskill_deploy.drivers.loopback_cell import LoopbackCell
from viskill_deploy.runtime import robots
from viskill_deploy.sim.tracker import TrackerOptions
from viskill_deploy.sim.world import World

ARMS = ["PSM1", "PSM2"]
TOPICS = topics_of("/tracker/{arm}/measured_cp", ARMS)


def test_a_point_is_of_when_its_stamp_says_and_one_in_another_frame_is_none() -> None:
    clock = SteppedClock()
    exchange = Exchange(clock)
    tips, node = TopicTips(Inproc(exchange), TOPICS), Inproc(exchange)
    publish = {arm: node.publisher(TOPICS[arm], PoseStamped) for arm in ARMS}
    seen_s = clock.now()
    seen = Time.of_ns(node.stamp_ns())
    clock.advance(0.03)
    publish["PSM1"](PoseStamped(Header(seen, "task"), Pose(Point(0.1, 0.2, 0.3))))
    publish["PSM2"](PoseStamped(Header(seen, "camera"), Pose(Point(0.1, 0.2, 0.3))))
    found = tips.points(clock.now())
    assert list(found) == ["PSM1"]
    assert found["PSM1"][0] == pytest.approx(seen_s)
    np.testing.assert_array_equal(found["PSM1"][1], [0.1, 0.2, 0.3])


def test_a_tracker_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robots, "FIND_S", 0.0)
    with pytest.raises(CalibrationError, match="PSM1's tip on /tracker/PSM1/measured_cp"):
        TopicTips(Inproc(Exchange(SteppedClock())), TOPICS).insist()
    with pytest.raises(CalibrationError, match="needs"):
        topics_of("/tips", ARMS)


def test_a_served_tracker_sees_the_tips_with_noise_and_outliers() -> None:
    clock = SteppedClock()
    exchange = Exchange(clock)
    world = World(load_cell("bipegtransfer"))
    world.reset(world.scene())
    options = TrackerOptions(noise_m=2e-4, outlier_share=0.2, outlier_m=0.02)
    front = CrtkCell(
        LoopbackCell(world), Inproc(exchange), ServerOptions(tracker=options, scene_hz=250.0)
    )
    heard: list[np.ndarray] = []
    Inproc(exchange).subscribe(
        tip_topic("PSM1"),
        PoseStamped,
        lambda word, _: heard.append(
            np.array([word.pose.position.x, word.pose.position.y, word.pose.position.z])
        ),
    )
    for _ in range(400):
        clock.advance(0.004)
        front.advance(clock.now())
    off = np.linalg.norm(np.array(heard) - world.tips()[0], axis=1)
    assert len(off) > 300
    assert 0.1 < (off > 2e-3).mean() < 0.3
    assert 1e-4 < np.median(off) < 1e-3
