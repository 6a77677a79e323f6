"""`viskill serve crtk` over ROS 1 and ROS 2, against a client of rospy or rclpy alone.

It does what a user of dVRK's Python client does in a session.
"""

import copy
import json
import math
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from crtk_domain import DOMAIN
from native_client import EACH_ROS, PATIENCE_S, NativeClient

from viskill_deploy.drivers.crtk import messages

SUPPORT = Path(__file__).parents[1] / "support"
HOMED = (0.0, 0.0, 0.12, 0.0, 0.0, 0.0)
BENT = [0.1, -0.1, 0.15, 0.3, 0.4, 0.2]
RATE_HZ = 200.0

pytestmark = [pytest.mark.timeout(300), EACH_ROS]


@contextmanager
def served(ros: str, folder: Path) -> Iterator[None]:
    """The command, from its first line of output until the block ends; it has no stray sockets."""
    told = folder / "strays.json"
    command = [sys.executable, str(SUPPORT / "tell_strays.py"), str(told), "serve", "crtk"]
    command += ["--transport", ros, "--domain", str(DOMAIN), "--arms", "PSM1"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout
            assert "simulated dVRK 2.4" in process.stdout.readline()
            yield
            process.send_signal(signal.SIGUSR1)
            deadline = time.monotonic() + PATIENCE_S
            while not told.exists() and time.monotonic() < deadline:
                time.sleep(0.01)
            assert json.loads(told.read_text()) == []
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=PATIENCE_S)


@pytest.fixture
def client(ros: str, ros_network: None) -> Iterator[Callable[[], NativeClient]]:
    made: list[NativeClient] = []

    def make() -> NativeClient:
        made.append(NativeClient(ros, DOMAIN))
        return made[-1]

    yield make
    for one in made:
        one.close()


def enabled_at_once(client: NativeClient, ros: str) -> None:
    """The first thing that is said, before anybody was found.

    ROS 1 latches it. dVRK's subscriber does not ask ROS 2 for what was said before it came, so that
    a client has to say it again until it has an effect.
    """
    client.command("enable")
    said_s = time.monotonic()
    while ros == "ros2" and client.state[0] != "ENABLED":
        assert time.monotonic() - said_s < PATIENCE_S
        time.sleep(0.5)
        client.command("enable")
    client.wait("no power", lambda: client.state == ("ENABLED", False, False))


def test_a_session_of_a_dvrk_client(
    ros: str, client: Callable[[], NativeClient], tmp_path: Path
) -> None:
    with served(ros, tmp_path):
        one = client()
        enabled_at_once(one, ros)
        one.wait("not all endpoints", lambda: not one.missing())
        one.command("home")
        one.wait("not homed", lambda: one.state == ("ENABLED", True, False))
        assert one.joints("setpoint_js") == pytest.approx(HOMED, abs=1e-6)

        one.moves("move_jp", position=BENT)
        one.wait_for("setpoint_js", BENT)
        one.wait("not there", lambda: np.allclose(one.joints("measured_js"), BENT, atol=1e-3))

        last = servoed(one, BENT)
        one.wait("last setpoint", lambda: one.joints("setpoint_js") == tuple(last))
        seen = {m.position[0] for m in one.heard["setpoint_js"]}
        assert len(seen) > 0.1 * RATE_HZ, "up to 100 readings in that second"

        for angle in (0.6, 0.0):
            one.moves("jaw/move_jp", position=[angle])
            one.wait_for("jaw/setpoint_js", [angle])
        pose = copy.deepcopy(one.heard["setpoint_cp"][-1].pose)
        pose.position.x += 0.005
        one.moves("move_cp", pose=pose)
        goal = (*point(pose), pose.orientation.w)
        one.wait("not there", lambda: np.allclose(held_pose(one), goal, atol=1e-6))

        program = [sys.executable, str(SUPPORT / "native_client.py"), ros, str(DOMAIN), "0.05"]
        second = subprocess.run(
            program, capture_output=True, text=True, timeout=PATIENCE_S * 3, check=False
        )
        assert second.returncode == 0, second.stderr
        told = json.loads(second.stdout)
        assert told["state"] == ["ENABLED", True, False]
        one.wait_for("setpoint_js", told["held"])
        one.moves("move_jp", position=BENT)
        one.wait_for("setpoint_js", BENT)

        ask_for_kinematics(one)
        stamps = [one.ros.ns(m.header) for m in one.heard["operating_state"]]
        assert all(b > a > 0 for a, b in pairwise(stamps))
        assert [m.data for m in one.heard["error"] + one.heard["warning"]] == []


def ask_for_kinematics(client: NativeClient) -> None:
    """The three services, which need no power."""
    forward = (messages.ForwardKinematicsRequest, messages.ForwardKinematicsResponse)
    inverse = (messages.InverseKinematicsRequest, messages.InverseKinematicsResponse)
    local = client.ros.ask("/PSM1/local/forward_kinematics", *forward)(jp=BENT)
    assert local.result, local.message
    at = local.cp.position
    assert math.hypot(at.x, at.y, at.z) == pytest.approx(0.15, abs=0.03)
    answer = client.ros.ask("/PSM1/inverse_kinematics", *inverse)(cp=local.cp, jp=[0.0] * 6)
    assert answer.result, answer.message
    assert list(answer.jp) == pytest.approx(BENT, abs=1e-6)
    task = client.ros.ask("/PSM1/forward_kinematics", *forward)(jp=BENT)
    assert task.result
    assert (task.cp.position.x, task.cp.position.y) != (at.x, at.y)
    far = copy.deepcopy(local.cp)
    far.position.z -= 1.0
    answer = client.ros.ask("/PSM1/inverse_kinematics", *inverse)(cp=far, jp=[0.0] * 6)
    assert (answer.result, answer.message != "") == (False, True)


def point(pose: Any) -> tuple[float, float, float]:
    return (pose.position.x, pose.position.y, pose.position.z)


def held_pose(client: NativeClient) -> tuple[float, ...]:
    pose = client.heard["setpoint_cp"][-1].pose
    return (*point(pose), pose.orientation.w)


def servoed(client: NativeClient, start: list[float]) -> list[float]:
    """Swings the first joint for a second at 200 Hz, there and back to somewhere else."""
    began, count = time.monotonic(), round(RATE_HZ)
    for k in range(1, count + 1):
        s = k / count
        ease = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        away = 0.03 * math.sin(math.pi * ease) + 0.01 * ease
        q = [start[0] + away, *start[1:]]
        client.say("servo_jp", position=q, velocity=[0.0] * 6)
        time.sleep(max(began + k / RATE_HZ - time.monotonic(), 0.0))
    return q


def test_nothing_moves_at_a_new_server_for_what_the_last_one_was_told(
    ros: str, client: Callable[[], NativeClient], tmp_path: Path
) -> None:
    one = client()
    with served(ros, tmp_path):
        one.wait("not all endpoints", lambda: not one.missing())
        enabled_at_once(one, ros)
        one.command("home")  # the last word, which is latched from now on
        one.wait("not homed", lambda: one.state == ("ENABLED", True, False))
    (tmp_path / "strays.json").unlink()
    for words in one.heard.values():
        words.clear()
    with served(ros, tmp_path):
        one.wait("not all endpoints", lambda: not one.missing())
        one.wait("no reading", lambda: one.heard["measured_js"])
        if ros == "ros1":  # ROS 2 hands an old one over only to those who ask for it
            one.wait("no warning", lambda: one.heard["warning"])
            assert "was sent before this server began" in one.heard["warning"][0].data
        time.sleep(2.0)
        assert {(m.state, m.is_busy) for m in one.heard["operating_state"]} == {("DISABLED", False)}
        held = np.array([m.position for m in one.heard["setpoint_js"]])
        assert np.ptp(held, axis=0).max() == 0.0
        assert np.ptp([m.position for m in one.heard["measured_js"]], axis=0).max() < 1e-3
