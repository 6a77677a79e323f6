"""A master of ROS 1 for the tests that need one, on the loopback and a port of its own."""

import os
import shutil
import socket
import subprocess
from collections.abc import Iterator

import pytest


@pytest.fixture(scope="session")
def ros_master(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Its address, which is also in the environment."""
    program = shutil.which("rosmaster")
    assert program, "rosmaster is missing; run tests/ros/install"
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    settings = {
        "ROS_MASTER_URI": f"http://127.0.0.1:{port}",
        "ROS_IP": "127.0.0.1",
        "ROS_HOSTNAME": "127.0.0.1",
        "ROS_LOG_DIR": str(tmp_path_factory.mktemp("ros-log")),
    }
    os.environ |= settings
    with subprocess.Popen([program, "--core", "-p", str(port)], env={**os.environ}) as master:
        try:
            wait_for_port(port, master)
            yield settings["ROS_MASTER_URI"]
        finally:
            master.terminate()


@pytest.fixture
def ros_network(ros: str, request: pytest.FixtureRequest) -> None:
    """What that ROS needs before anybody speaks."""
    if ros == "ros1":
        request.getfixturevalue("ros_master")


def wait_for_port(port: int, master: "subprocess.Popen[bytes]") -> None:
    while True:
        assert master.poll() is None, "rosmaster ended"
        with socket.socket() as one:
            if one.connect_ex(("127.0.0.1", port)) == 0:
                return
        with socket.socket() as one:
            one.settimeout(0.05)
            one.bind(("127.0.0.1", 0))
            try:
                one.listen()
                one.accept()
            except TimeoutError:
                continue
