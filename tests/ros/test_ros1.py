"""What only ROS 1 does: services, hashes of definitions, a master that may be missing."""

import importlib
import os
import subprocess
import sys

import crtk_samples
import pytest
from crtk_domain import DOMAIN
from crtk_peer import peer

from viskill_deploy.core.errors import DriverError
from viskill_deploy.drivers.crtk import messages
from viskill_deploy.drivers.crtk.opening import LOOPBACK, Network, open_transport

pytestmark = pytest.mark.ros1

OPERATING_STATE_MD5 = "b1bd4021639d9d9c5fbfff78d6ff3158"
STANDARD = sorted(
    name for name in crtk_samples.MESSAGES if "crtk" not in name and "Time" not in name
)


def test_the_operating_state_is_the_robots() -> None:
    from viskill_deploy.drivers.crtk.ros1_types import ros1_class

    assert ros1_class(messages.OperatingState)._md5sum == OPERATING_STATE_MD5


@pytest.mark.parametrize("name", STANDARD)
def test_every_standard_message_has_the_hash_of_the_installed_package(name: str) -> None:
    from viskill_deploy.drivers.crtk.ros1_types import ros1_class

    package, kind = name.split("/")
    installed = getattr(importlib.import_module(f"{package}.msg"), kind)
    made = ros1_class(crtk_samples.MESSAGES[name])
    assert (made._type, made._md5sum) == (installed._type, installed._md5sum)


def test_services_answer_another_process(ros_master: str) -> None:
    import rospy

    from viskill_deploy.drivers.crtk.ros1_types import service_class

    node = open_transport("ros1", Network(interface=LOOPBACK))
    inverse = service_class(messages.InverseKinematicsRequest, messages.InverseKinematicsResponse)
    forward = service_class(messages.ForwardKinematicsRequest, messages.ForwardKinematicsResponse)
    with peer("ros1", "serve", DOMAIN):
        ask = rospy.ServiceProxy("/PSM1/inverse_kinematics", inverse)
        question = inverse._request_class(jp=[0.5, -1.0])
        question.cp.position.z = 0.1
        answer = ask(question)
        assert tuple(answer.jp) == (1.0, -2.0, 0.0, 0.0, 0.1)
        assert (answer.result, answer.message) == (True, "as foretold")
        ask = rospy.ServiceProxy("/PSM1/forward_kinematics", forward)
        answer = ask(forward._request_class(jp=[0.1, 0.2, 0.3]))
        assert (answer.cp.position.x, answer.cp.position.y, answer.cp.position.z) == (0.1, 0.2, 0.3)
        assert (answer.result, answer.message) == (False, "no such arm")
    node.close()
    with pytest.raises(DriverError, match="closed"):
        node.serve(
            "/PSM1/forward_kinematics",
            messages.ForwardKinematicsRequest,
            messages.ForwardKinematicsResponse,
            lambda request: messages.ForwardKinematicsResponse(),
        )


def test_it_is_taken_by_itself_where_ros1_was_sourced(
    ros_master: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_VERSION", "1")
    node = open_transport("auto", Network(interface=LOOPBACK))
    assert node.name == "ros1"
    node.close()


def test_a_master_that_does_not_answer_is_an_error_and_no_wait() -> None:
    command = [
        sys.executable,
        "-c",
        "from viskill_deploy.drivers.crtk.opening import *\n"
        "open_transport('ros1', Network(interface=LOOPBACK))",
    ]
    settings = {**os.environ, "ROS_MASTER_URI": "http://127.0.0.1:9"}
    told = subprocess.run(
        command, check=False, env=settings, capture_output=True, text=True, timeout=30
    )
    assert "no ROS 1 master answers at http://127.0.0.1:9; start roscore" in told.stderr
