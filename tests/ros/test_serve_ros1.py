"""`viskill serve crtk` over ROS 1, against a client that does as dVRK's Python client does.

That client latches state_command and does not stamp it.
"""

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from viskill_deploy.drivers.crtk import messages

pytestmark = pytest.mark.ros1

PATIENCE_S = 30.0


@contextmanager
def served() -> Iterator["subprocess.Popen[str]"]:
    """The command, until the block ends."""
    command = [sys.executable, "-m", "viskill_deploy.cli.main", "serve", "crtk"]
    command += ["--transport", "ros1", "--arms", "PSM1"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(PATIENCE_S)


class DvrkClient:
    """What dVRK's client opens, with rospy itself."""

    def __init__(self) -> None:
        import rospy

        from viskill_deploy.drivers.crtk.ros1_types import ros1_class

        if not rospy.core.is_initialized():  # a process is one node, whoever made it
            rospy.init_node("dvrk_client", anonymous=True, disable_signals=True)
        self._stamped = ros1_class(messages.StringStamped)
        self._joints = ros1_class(messages.JointState)
        self.states: list[Any] = []
        self.warnings: list[str] = []
        self.setpoints: list[Any] = []
        state, text = ros1_class(messages.OperatingState), ros1_class(messages.String)
        rospy.Subscriber("/PSM1/operating_state", state, self.states.append)
        rospy.Subscriber("/PSM1/warning", text, lambda m: self.warnings.append(m.data))
        rospy.Subscriber("/PSM1/setpoint_js", self._joints, self.setpoints.append)
        latched = {"latch": True, "queue_size": 1}
        self._command = rospy.Publisher("/PSM1/state_command", self._stamped, **latched)
        self._move = rospy.Publisher("/PSM1/move_jp", self._joints, queue_size=1)

    def command(self, word: str) -> None:
        message = self._stamped()
        message.string = word
        self._command.publish(message)

    def move(self, *joints: float) -> None:
        message = self._joints()
        message.position = joints
        self._move.publish(message)

    def wait(self, what: str, is_so: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not is_so():
            assert time.monotonic() < deadline, f"{what}: {self.states[-1:]} {self.warnings[-3:]}"
            time.sleep(0.01)

    def close(self) -> None:
        """Nothing stays latched for the arms of other tests."""
        self._command.unregister()
        self._move.unregister()

    @property
    def summary(self) -> tuple[str, bool, bool]:
        if not self.states:
            return ("", False, False)
        return (self.states[-1].state, self.states[-1].is_homed, self.states[-1].is_busy)


def test_an_unstamped_command_is_obeyed_by_the_server_it_is_for_and_not_by_the_next_one(
    ros_master: str,
) -> None:
    client = DvrkClient()
    with served():
        client.wait("no state", lambda: client.summary[0] == "DISABLED")
        time.sleep(5.5)
        client.command("enable")
        client.wait("no power", lambda: client.summary == ("ENABLED", False, False))
        client.command("home")
        client.wait("not homed", lambda: client.summary == ("ENABLED", True, False))
        client.move(0.1, 0.0, 0.12, 0.0, 0.0, 0.0)
        client.wait("not busy", lambda: client.summary[2])
        client.wait("not there", lambda: not client.summary[2])
        assert client.setpoints[-1].position[0] == pytest.approx(0.1, abs=1e-9)
        client.command("enable")  # the last word, which is latched from now on
    client.states.clear()
    client.warnings.clear()
    with served():
        client.wait("no state", lambda: client.summary[0] == "DISABLED")
        client.wait("no warning", lambda: bool(client.warnings))
        assert "has no stamp and may be an old one" in client.warnings[0]
        time.sleep(2.0)
        assert {state.state for state in client.states} == {"DISABLED"}
        assert not any(state.is_busy for state in client.states)
    client.close()
