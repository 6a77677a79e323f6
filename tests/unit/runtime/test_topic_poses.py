"""Poses of a tracker on topics: what is taken, and what is not."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from viskill_deploy.core.clock import SteppedClock
from viskill_deploy.core.description import rpy_matrix
from viskill_deploy.drivers.crtk.arm_cartesian import pose_of
from viskill_deploy.drivers.crtk.inproc import START_NS, Exchange, Inproc
from viskill_deploy.drivers.crtk.messages import NANO, Header, PoseStamped, Time
from viskill_deploy.runtime.topic_poses import TopicPoses, matrix_of

TOPIC = "/scene/block1/measured_cp"
Say = Callable[..., None]


def turned(roll: float, pitch: float, yaw: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rpy_matrix(roll, pitch, yaw), (0.01, -0.02, 0.03)
    return T


@pytest.fixture
def tracker() -> tuple[TopicPoses, Say, SteppedClock]:
    clock = SteppedClock()
    exchange = Exchange(clock)
    poses = TopicPoses(Inproc(exchange), {"block1": TOPIC}, {"block1": 0.0005})
    publish = Inproc(exchange).publisher(TOPIC, PoseStamped)

    def say(T: np.ndarray, seen_s: float, frame: str = "task") -> None:
        stamp = Time.of_ns(START_NS + round(seen_s * NANO))
        publish(PoseStamped(Header(stamp, frame), pose_of(T)))

    return poses, say, clock


@pytest.mark.parametrize("angles", [(0.1, -0.4, 2.0), (math.pi, 0.0, 0.3), (0.0, 0.0, -3.1)])
def test_a_pose_comes_back_as_the_matrix_that_it_was(angles: tuple[float, float, float]) -> None:
    T = matrix_of(pose_of(turned(*angles)))
    assert T is not None
    np.testing.assert_allclose(T, turned(*angles), atol=1e-12)


def test_the_newest_pose_counts_from_when_it_was_seen(
    tracker: tuple[TopicPoses, Say, SteppedClock],
) -> None:
    poses, say, clock = tracker
    assert poses.newest("block1") is None
    began = clock.now()
    clock.advance(2.0)
    say(turned(0, 0, 1), began + 1.9)
    seen = poses.newest("block1")
    assert seen is not None
    assert seen.seen_s == pytest.approx(began + 1.9, abs=1e-6)
    assert seen.sigma_m == 0.0005
    np.testing.assert_allclose(seen.T_task_object, turned(0, 0, 1), atol=1e-12)


def test_a_pose_from_the_future_is_no_younger_than_now(
    tracker: tuple[TopicPoses, Say, SteppedClock],
) -> None:
    poses, say, clock = tracker
    say(turned(0, 0, 1), clock.now() + 100.0)
    seen = poses.newest("block1")
    assert seen is not None
    assert seen.seen_s == pytest.approx(clock.now())


@pytest.mark.parametrize("again", [{"seen_s": 0.5}, {"seen_s": 0.4}])
def test_a_pose_that_is_said_again_or_late_is_not_a_new_look(
    tracker: tuple[TopicPoses, Say, SteppedClock], again: dict[str, float]
) -> None:
    poses, say, clock = tracker
    clock.advance(1.0)
    say(turned(0, 0, 1), 0.5)
    first = poses.newest("block1")
    clock.advance(1.0)
    say(turned(0, 0, 2), **again)
    assert poses.newest("block1") is first


def test_poses_in_other_frames_and_poses_that_are_none_are_not_taken(
    tracker: tuple[TopicPoses, Say, SteppedClock],
) -> None:
    poses, say, clock = tracker
    clock.advance(1.0)
    say(turned(0, 0, 1), 0.5, frame="camera")
    say(np.full((4, 4), math.nan), 0.6)
    assert poses.newest("block1") is None
    long = pose_of(turned(0, 0, 1))
    q = type(long.orientation)(0.0, 0.0, 0.0, 1.1)
    assert matrix_of(type(long)(long.position, q)) is None
    say(turned(0, 0, 1), 0.7, frame="")
    assert poses.newest("block1") is not None
