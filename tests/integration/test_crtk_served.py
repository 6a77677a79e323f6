"""A simulated dVRK in a process of its own, over DDS, with a client that knows only CRTK."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import pytest

from viskill_deploy.core.description import load_cell
from viskill_deploy.drivers.crtk.messages import (
    NANO,
    Empty,
    Float64MultiArray,
    Header,
    JointState,
    OperatingState,
    PoseStamped,
    StringStamped,
    Time,
)
from viskill_deploy.drivers.crtk.opening import LOOPBACK, Network, open_transport
from viskill_deploy.drivers.crtk.topics import ARM
from viskill_deploy.drivers.loopback_served import ServedLoopback

DOMAIN = 60 + os.getpid() % 100
PATIENCE_S = 20.0


class Client:
    """One arm's client on DDS."""

    def __init__(self, arm: str = "PSM1") -> None:
        self.node = open_transport("dds", Network(DOMAIN, LOOPBACK))
        self.heard: dict[str, list[Any]] = {}
        self.say: dict[str, Any] = {}
        for topic in ARM:
            name = f"/{arm}/{topic.name}"
            if topic.publisher == "client":
                self.say[topic.name] = self.node.publisher(name, topic.message)
            elif topic.name != "IO/arm_clutch":
                kept = self.heard.setdefault(topic.name, [])
                self.node.subscribe(
                    name, topic.message, lambda m, _, k=kept: k.append(m), topic.is_latched
                )
        self.names = [f"/{arm}/{topic.name}" for topic in ARM if topic.is_demanded]

    def wait(self, what: str, is_so: Any) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not is_so():
            assert time.monotonic() < deadline, f"{what}; heard {self.state}"
            time.sleep(0.005)

    @property
    def state(self) -> OperatingState:
        states = self.heard["operating_state"]
        return states[-1] if states else OperatingState()

    def command(self, word: str) -> None:
        stamp = Time.of_ns(self.node.stamp_ns())
        self.say["state_command"](StringStamped(Header(stamp), word))

    def moves(self, topic: str, message: Any) -> None:
        """Sends a motion and waits as dVRK's client does: busy after the request, then not."""
        began = self.node.stamp_ns()
        self.say[topic](message)
        self.wait(f"{topic} does not begin", lambda: self._after(began, True))
        self.wait(f"{topic} does not end", lambda: self._after(began, True) and self._idle())

    def _after(self, began: int, is_busy: bool) -> bool:
        states = list(self.heard["operating_state"])
        return any(s.header.stamp.ns > began and s.is_busy == is_busy for s in states)

    def _idle(self) -> bool:
        return not self.state.is_busy


@pytest.fixture
def server() -> Iterator[ServedLoopback]:
    network = f'{{"domain": {DOMAIN}, "interface": "{LOOPBACK}"}}'
    arguments = ("--transport", "dds", "--network", network, "--crtk", '{"homing": "dvrk"}')
    module = "viskill_deploy.drivers.crtk.server"
    served = ServedLoopback(
        load_cell("bipegtransfer"), server=module, arguments=arguments, is_watched=False
    )
    served.connect()
    yield served
    served.close()


def test_a_crtk_client_in_another_process_enables_homes_and_moves_an_arm(
    server: ServedLoopback,
) -> None:
    client = Client()
    client.wait("not all endpoints", lambda: all(map(client.node.peers, client.names)))
    client.wait("no state", lambda: client.state.state == "DISABLED")

    client.command("enable")
    client.wait("no power", lambda: client.state.state == "ENABLED")
    client.command("home")
    client.wait("not homed", lambda: client.state.is_homed and not client.state.is_busy)
    q = client.heard["setpoint_js"][-1].position
    assert q == pytest.approx((0.0, 0.0, 0.12, 0.0, 0.0, 0.0), abs=1e-6)

    goal = (0.1, *q[1:])
    client.moves("move_jp", JointState(position=goal))
    assert client.heard["setpoint_js"][-1].position == pytest.approx(goal, abs=1e-9)
    client.moves("jaw/move_jp", JointState(position=(0.3,)))
    client.moves("move_cp", client.heard["setpoint_cp"][-1])
    client.say["servo_jp"](JointState(position=(0.12, *q[1:]), velocity=(0.0,) * 6))
    client.wait("no servo", lambda: abs(client.heard["measured_js"][-1].position[0] - 0.12) < 1e-3)
    assert server.heard()["heard"] == 1
    client.say["hold"](Empty())
    assert isinstance(client.heard["body/jacobian"][-1], Float64MultiArray)
    assert isinstance(client.heard["measured_cp"][-1], PoseStamped)

    states = [s.header.stamp.ns for s in client.heard["operating_state"]]
    assert all(a < b for a, b in pairwise(states))
    assert client.heard["error"] == client.heard["warning"] == []
    client.wait("elsewhere", lambda: abs(server.truth().arms[0].measured_jp[0] - 0.12) < 2e-3)
    client.node.close()


def test_faults_are_caused_and_ended_over_the_private_socket(server: ServedLoopback) -> None:
    client = Client("PSM2")
    client.wait("no state", lambda: client.state.state == "DISABLED")
    client.command("enable")
    client.wait("no power", lambda: client.state.state == "ENABLED")
    server.cause("tracking", "PSM2")
    client.wait("no fault", lambda: client.state.state == "FAULT")
    assert "tracking error" in client.heard["error"][-1].data
    client.command("disable")
    client.wait("not disabled", lambda: client.state.state == "DISABLED")
    server.cause("silence", "PSM2")
    time.sleep(0.1)
    count = len(client.heard["measured_js"])
    time.sleep(0.1)
    assert len(client.heard["measured_js"]) == count
    server.cause("silence", "PSM2", False)
    client.wait("still silent", lambda: len(client.heard["measured_js"]) > count)
    client.node.close()


def test_viskill_serve_says_what_it_serves_and_ends_with_ctrl_c() -> None:
    command = [sys.executable, "-m", "viskill_deploy.cli.main", "serve", "crtk"]
    command += ["--transport", "dds", "--domain", str(DOMAIN), "--arms", "PSM1", "--truth", "3"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    client = Client()
    client.wait("no state", lambda: client.state.state == "DISABLED")
    began = len(client.heard["measured_js"])
    time.sleep(1.0)
    assert 60 <= len(client.heard["measured_js"]) - began <= 110
    age = client.node.stamp_ns() - client.heard["measured_js"][-1].header.stamp.ns
    assert age < 0.1 * NANO
    client.command("enable")
    client.wait("no power", lambda: client.state.state == "ENABLED")
    process.send_signal(signal.SIGINT)
    out, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    lines = out.splitlines()
    assert lines[0] == "simulated dVRK 2.4 over dds, on this machine only"
    assert "arms:    /PSM1, at 100 Hz" in lines
    assert "robot:   hidden, truth 3" in lines
    assert lines[-4:] == ["PSM1: DISABLED", "PSM1: DISABLED, busy", "PSM1: ENABLED", "stopped"]
    client.node.close()
