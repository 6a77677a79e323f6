"""The conformance suite of drivers over ROS 1 and ROS 2, against arms in a process of their own."""

from collections.abc import Iterator

import numpy as np
import pytest
import served_arms

from tests.integration.test_driver_conformance import *  # noqa: F403 - the tests, every one
from viskill_deploy.drivers.base import Driver
from viskill_deploy.sim.tasks.base import load_task

LAYOUT = load_task("bipegtransfer").sample_layout(np.random.default_rng(0), "reference")


@pytest.fixture(
    params=[
        pytest.param("ros1", marks=pytest.mark.ros1),
        pytest.param("ros2", marks=pytest.mark.ros2),
    ]
)
def driver(request: pytest.FixtureRequest) -> Iterator[Driver]:
    if request.param == "ros1":
        request.getfixturevalue("ros_master")
    made = served_arms.connected(request.param)
    made.reset(LAYOUT)
    yield made
    made.close()
