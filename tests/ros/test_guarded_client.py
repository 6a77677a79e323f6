"""`viskill guard` between a simulated dVRK and a client of rospy or rclpy alone."""

import contextlib
import math
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from crtk_domain import DOMAIN
from native_client import EACH_ROS, PATIENCE_S, NativeClient

from viskill_deploy.drivers.crtk.opening import LOOPBACK
from viskill_deploy.observe.reading import read_recording

RATE_HZ = 100.0

pytestmark = [pytest.mark.timeout(600), EACH_ROS]


@contextmanager
def running(*words: str) -> Iterator["subprocess.Popen[str]"]:
    """A `viskill` command with a terminal to type into."""
    command = [sys.executable, "-m", "viskill_deploy.cli.main", *words]
    pipe, nowhere = subprocess.PIPE, subprocess.DEVNULL
    with subprocess.Popen(command, text=True, stdin=pipe, stdout=nowhere) as process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.communicate(timeout=PATIENCE_S)
            process.kill()


def type_in(process: "subprocess.Popen[str]", word: str) -> None:
    assert process.stdin
    process.stdin.write(f"{word}\n")
    process.stdin.flush()


@pytest.mark.usefixtures("ros_network")
def test_a_client_that_we_did_not_write_is_passed_stopped_and_told(
    ros: str, tmp_path: Path
) -> None:
    """A machine that is late holds the arms before the leap, and the client hears that, too."""
    way = ("--transport", ros, "--domain", str(DOMAIN), "--interface", LOOPBACK)
    rate = ("--rate", f"{RATE_HZ:g}")
    with (
        running("serve", "crtk", "--homing", "stay", *way) as robot,
        running("guard", "--simulated", *rate, "--output", str(tmp_path / "run"), *way),
    ):
        client = NativeClient(ros, DOMAIN, "guarded/PSM1")
        try:
            made_ready(client, robot)
            is_whole = streamed(client)
            is_stopped_for_a_leap(client, is_whole)
        finally:
            client.close()
    recording = read_recording(tmp_path / "run/recording")
    assert recording.complete
    rules = {row.rule for row in recording.verdicts}
    assert "S10" in rules if is_whole else rules - {""}


def made_ready(client: NativeClient, robot: "subprocess.Popen[str]") -> None:
    """Enabled, homed, agreed to by the operator; what one arm is told counts for all."""
    client.wait("not all endpoints", lambda: not client.missing())
    client.wait("no reading", lambda: client.heard["setpoint_js"])
    for word, state in (("enable", ("ENABLED", False, False)), ("home", ("ENABLED", True, True))):
        client.command(word)
        client.wait(f"not {state}", lambda state=state: client.state == state)
    deadline = time.monotonic() + PATIENCE_S
    while client.state != ("ENABLED", True, False):  # a gate that has a late state is not armed
        assert time.monotonic() < deadline, f"no consent; {client.state}"
        type_in(robot, "release")
        time.sleep(0.5)
        type_in(robot, "press")
        time.sleep(1.5)


def streamed(client: NativeClient) -> bool:
    """Swings the first joint and ends somewhere else; whether all of it has passed."""
    start = client.joints("setpoint_js")
    began, count = time.monotonic(), round(2.0 * RATE_HZ)
    for k in range(1, count + 1):
        s = k / count
        way = 0.03 * s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
        q = [start[0] + way, *start[1:]]
        client.say("servo_jp", position=q)
        time.sleep(max(began + k / RATE_HZ - time.monotonic(), 0.0))
    time.sleep(0.3)
    if client.state[0] != "ENABLED":
        return False
    client.wait_for("setpoint_js", q)
    seen = {m.position[0] for m in client.heard["setpoint_js"]}
    assert len(seen) > 0.2 * count, "the arm went there, and did not leap"
    return True


def is_stopped_for_a_leap(client: NativeClient, is_whole: bool) -> None:
    """Nothing of it reaches the robot; the arms are held, and the client hears why."""
    held = client.joints("setpoint_js")
    client.say("servo_jp", position=[held[0] + math.radians(28.0), *held[1:]])
    client.wait("not held", lambda: client.state[0] != "ENABLED")
    said, errors = client.heard["warning"], client.heard["error"]
    why = "tip speed (S10): STOP" if is_whole else "(S"
    client.wait("no reason", lambda: any(why in m.data for m in said))
    time.sleep(0.3)
    assert client.joints("setpoint_js") == pytest.approx(held, abs=1e-4)
    deadline = time.monotonic() + PATIENCE_S
    while not any("move_jp does not pass" in m.data for m in errors):
        assert time.monotonic() < deadline, [m.data for m in errors]
        client.say("move_jp", position=list(held))
        time.sleep(0.2)
